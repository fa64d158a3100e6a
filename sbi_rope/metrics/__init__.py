r"""Scores of a posterior on observations whose true parameters are known.

Any sbi posterior can be scored that has ``sample_batched``, for scores of calibration,
and ``log_prob_batched``, for scores of the density. The test set consists of ``theta``,
shape ``(n, d)``, and ``x``, shape ``(n, *event_shape)``, both on the device of the
posterior.

:func:`evaluate` draws the samples once and returns all scores. The other functions
return one score each. All of them use the functions in
``sbi_rope.metrics.calibration``, which take ranks and levels and need no posterior.

No score enters sbi's unbounded rejection loops: see ``sbi_rope.metrics.calls``.
"""

from sbi_rope.metrics.by_estimate import CoverageByEstimate, coverage_by_estimate
from sbi_rope.metrics.calibration import (
    ACAUCScore,
    CoverageCurve,
    CoverageErrorScore,
    acauc_of,
    central_levels,
    coverage_curve_of,
    expected_coverage_error_of,
    mid_ranks,
)
from sbi_rope.metrics.calls import draw_samples
from sbi_rope.metrics.coverage import acauc, coverage_curve, expected_coverage_error
from sbi_rope.metrics.density import LPPScore, lpp
from sbi_rope.metrics.evaluation import Evaluation, evaluate

__all__ = [
    "ACAUCScore",
    "CoverageByEstimate",
    "CoverageCurve",
    "CoverageErrorScore",
    "Evaluation",
    "LPPScore",
    "acauc",
    "acauc_of",
    "central_levels",
    "coverage_by_estimate",
    "coverage_curve",
    "coverage_curve_of",
    "draw_samples",
    "evaluate",
    "expected_coverage_error",
    "expected_coverage_error_of",
    "lpp",
    "mid_ranks",
]
