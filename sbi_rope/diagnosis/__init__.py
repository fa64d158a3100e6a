"""Diagnosis of a batch: tests of the assumptions that posteriors make about it."""

from sbi_rope.diagnosis.batch import diagnose
from sbi_rope.diagnosis.report import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
