"""Credible sets and intervals for one observation, with a guarantee or without."""

from sbi_rope.sets.conformal import Guarantee
from sbi_rope.sets.credible import CredibleIntervals, CredibleSet

__all__ = ["CredibleIntervals", "CredibleSet", "Guarantee"]
