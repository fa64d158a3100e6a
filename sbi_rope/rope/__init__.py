"""Robust posterior estimation: tune, couple, mix."""

from sbi_rope.rope.finetuning import CalibrationFinetuner
from sbi_rope.rope.rope import RoPE

__all__ = ["CalibrationFinetuner", "RoPE"]
