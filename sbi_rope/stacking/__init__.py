"""Stacking: weights over candidate posteriors from held-out calibration pairs."""

from sbi_rope.stacking.candidates import (
    CouplingCandidate,
    DensityCandidate,
    default_candidates,
)
from sbi_rope.stacking.cross_validation import (
    CrossValidation,
    Difference,
    cross_validate,
)
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.report import LearningCurve, StackingReport
from sbi_rope.stacking.stack import stack
from sbi_rope.stacking.weights import StackingWeights, stacking_weights

__all__ = [
    "CouplingCandidate",
    "CrossValidation",
    "DensityCandidate",
    "Difference",
    "LearningCurve",
    "StackedPosterior",
    "StackingReport",
    "StackingWeights",
    "cross_validate",
    "default_candidates",
    "stack",
    "stacking_weights",
]
