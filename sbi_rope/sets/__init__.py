"""Credible sets and intervals for one observation, with a guarantee or without."""

from sbi_rope.sets.credible_set import CredibleSet
from sbi_rope.sets.guarantee import Guarantee
from sbi_rope.sets.intervals import CredibleIntervals

__all__ = ["CredibleIntervals", "CredibleSet", "Guarantee"]
