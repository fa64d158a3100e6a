"""Robust posterior estimation: tune, couple, mix."""

from sbi_rope.rope.finetuning import CalibrationFinetuner
from sbi_rope.rope.rope import EmbeddedBatch, RoPE

__all__ = [
    "CalibrationFinetuner",
    "EmbeddedBatch",
    "RoPE",
]
