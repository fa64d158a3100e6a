"""Stacking: candidate posteriors, weighted by their scores on held-out pairs."""

from sbi_rope.stacking.candidates import (
    Candidate,
    DensityCandidate,
    DiscrepancyCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
    RVNPCandidate,
    default_candidates,
)
from sbi_rope.stacking.cross_validation import (
    CrossValidation,
    Difference,
    LearningCurve,
    SetScores,
)
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.report import Provenance, StackingReport
from sbi_rope.stacking.stack import cross_validate, stack
from sbi_rope.stacking.weights import StackingWeights, stacking_weights

__all__ = [
    "Candidate",
    "CrossValidation",
    "DensityCandidate",
    "Difference",
    "DiscrepancyCandidate",
    "FinetunedCandidate",
    "LearningCurve",
    "Provenance",
    "RVNPCandidate",
    "RehearsedCandidate",
    "SetScores",
    "StackedPosterior",
    "StackingReport",
    "StackingWeights",
    "cross_validate",
    "default_candidates",
    "stack",
    "stacking_weights",
]
