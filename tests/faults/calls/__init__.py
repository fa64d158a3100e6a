"""Every public callable with good arguments, which the tests replace by bad ones.

To add a function, add a :class:`~tests.faults.outcomes.Call` to the module of its
package. Each of its ``tensors`` is replaced by each bad tensor in turn, and each of its
``options`` by each bad value of its kind. ``tests/faults/inputs.py`` lists both. Name
in ``accepts`` what is bad elsewhere but means something to this function.
"""

from tests.faults.calls import (
    baselines,
    discrepancy,
    metrics,
    plots,
    posteriors,
    rope,
    saving,
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
    *saving.CALLS,
    *tasks.CALLS,
]

_RESULT = "a result, which users read and do not make"
_FOR_STACK = "called by a stack, with arguments that the stack has made"
_PART = "a part of a posterior or method, which checks what its parts are given"
# Classes and functions that no bad argument of a user can reach.
NOT_CALLED = {
    **dict.fromkeys(
        (
            "ACAUCScore",
            "Coupling",
            "CoverageByEstimate",
            "CoverageCurve",
            "CoverageErrorScore",
            "CredibleIntervals",
            "CredibleSet",
            "CrossValidation",
            "Diagnosis",
            "Difference",
            "Discrepancy",
            "DiscrepancyDraws",
            "DiscrepancyReport",
            "Evaluation",
            "FinetuneResult",
            "Finding",
            "Guarantee",
            "History",
            "Interval",
            "LPPScore",
            "Leakage",
            "LearningCurve",
            "ParameterDistribution",
            "Provenance",
            "SetScores",
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
            "EmbeddedBatch",
            "MixtureEstimator",
            "MixturePosterior",
            "OwnEmbeddings",
            "Part",
            "Rows",
            "StackedPosterior",
            "check_converged",
            "equal_rows",
            "parameters_named",
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
            "RVNPCandidate.applies_to",
            "RVNPCandidate.parts",
            "RehearsedCandidate.applies_to",
            "RehearsedCandidate.parts",
        ),
        _FOR_STACK,
    ),
    "PriorPosterior.map": "sbi's own",
    "in_digits": "called with parameters that were checked",
    "shown": "shows anything",
    "warn_user": "says what it is told",
    "write_stacking_report": "called by StackingReport.to_html, which is in the table",
}
