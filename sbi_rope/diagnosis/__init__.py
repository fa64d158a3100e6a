"""Diagnosis of a batch: are the assumptions of RoPE about it fulfilled?"""

from sbi_rope.diagnosis.batch import diagnose
from sbi_rope.diagnosis.report import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
