"""Diagnosis of a batch: can it be trusted to what RoPE does with it?"""

from sbi_rope.diagnosis.batch import diagnose
from sbi_rope.diagnosis.report import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
