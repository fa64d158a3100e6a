"""Calibration pairs, labels that are not exact, and simulators."""

from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import parallel

__all__ = ["Pairs", "parallel"]
