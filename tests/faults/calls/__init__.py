"""Every public callable with good arguments, to be spoilt by the tests.

To add a function, add a :class:`~tests.faults.outcomes.Call` to the module of its
package. ``tensors`` are given each bad input in turn, and ``options`` each bad value of
their kind; both are listed in ``tests/faults/inputs.py``. What is bad elsewhere but
means something to this function goes into ``accepts``.
"""

from tests.faults.calls import (
    baselines,
    discrepancy,
    metrics,
    plots,
    posteriors,
    rope,
    stacking,
    tasks,
)

__all__ = ["CALLS", "NOT_CALLED"]

CALLS = [
    *rope.CALLS,
    *posteriors.CALLS,
    *stacking.CALLS,
    *discrepancy.CALLS,
    *baselines.CALLS,
    *metrics.CALLS,
    *plots.CALLS,
    *tasks.CALLS,
]

_RESULT = "what a call returns: users read it and do not make it"
_FOR_STACK = "called by a stack, with what it has made"
_PART = "a part of a posterior, which checks what its parts are given"
# Classes and functions that no bad argument of a user reaches.
NOT_CALLED = {
    **dict.fromkeys(
        (
            "ACAUCScore",
            "Coupling",
            "CoverageCurve",
            "CoverageErrorScore",
            "CrossValidation",
            "Diagnosis",
            "Difference",
            "Discrepancy",
            "DiscrepancyDraws",
            "DiscrepancyReport",
            "Evaluation",
            "FinetuneResult",
            "Finding",
            "History",
            "Interval",
            "LPPScore",
            "Leakage",
            "LearningCurve",
            "ParameterDistribution",
            "StackingReport",
            "StackingReport.of",
            "StackingWeights",
            "SummaryDiscrepancy",
        ),
        _RESULT,
    ),
    **dict.fromkeys(
        (
            "CoupledEmbeddings",
            "CoupledNet",
            "MixtureEstimator",
            "MixturePosterior",
            "OwnEmbeddings",
            "Part",
            "Rows",
            "StackedPosterior",
            "equal_rows",
            "part_of",
            "part_of_prior",
        ),
        _PART,
    ),
    **dict.fromkeys(
        (
            "CrossValidation.difference",
            "CrossValidation.scores_of",
            "DensityCandidate.applies_to",
            "DensityCandidate.parts",
            "DiscrepancyCandidate.applies_to",
            "DiscrepancyCandidate.parts",
            "FinetunedCandidate.applies_to",
            "FinetunedCandidate.parts",
        ),
        _FOR_STACK,
    ),
    "PriorPosterior.map": "sbi's own",
    "shown": "shows anything",
    "warn_user": "says what it is told",
}
