"""Posteriors in files that other processes, and other people, load without risk."""

from sbi_rope.saving.files import load, save

__all__ = ["load", "save"]
