"""Stacking: candidate posteriors, weighted by their scores on held-out pairs."""

from sbi_rope.stacking.candidates import (
    Candidate,
    GivenCandidate,
    default_candidates,
)
from sbi_rope.stacking.data import StackData
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.report import LearningCurve, StackingReport
from sbi_rope.stacking.stack import stack
from sbi_rope.stacking.weights import stacking_weights

__all__ = [
    "Candidate",
    "GivenCandidate",
    "LearningCurve",
    "StackData",
    "StackedPosterior",
    "StackingReport",
    "default_candidates",
    "stack",
    "stacking_weights",
]
