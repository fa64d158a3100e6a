"""The hybrid variational auto-encoder: real data explained by physics and a residue."""

from sbi_rope.baselines.hvae.method import HVAE

__all__ = ["HVAE"]
