"""Stacking: candidate posteriors, weighted by their scores on held-out pairs."""

from sbi_rope.stacking.candidates import (
    AmortisedCandidate,
    CouplingCandidate,
    DensityCandidate,
)
from sbi_rope.stacking.cross_validation import CrossValidation, Difference
from sbi_rope.stacking.defaults import default_candidates
from sbi_rope.stacking.held_out import SetScores
from sbi_rope.stacking.learning_curve import LearningCurve
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.provenance import Provenance
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.stack import cross_validate, stack
from sbi_rope.stacking.trained_candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
)
from sbi_rope.stacking.unlabelled_candidates import RVNPCandidate
from sbi_rope.stacking.weights import StackingWeights, stacking_weights

__all__ = [
    "AmortisedCandidate",
    "CouplingCandidate",
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
