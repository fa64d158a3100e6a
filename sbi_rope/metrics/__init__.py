r"""Scores of a posterior on observations whose true parameters are known.

Any sbi posterior with ``sample_batched`` (calibration) and ``log_prob_batched``
(density) can be scored, on a test set of ``theta``, shape ``(n, k)``, and ``x``, shape
``(n, *event_shape)``, both on the device the posterior lives on.

:func:`evaluate` draws the samples once and returns every score; the other functions
return one score each. They all rest on the pure functions of
:mod:`sbi_rope.metrics.calibration`, which know ranks and levels but no posterior.

Neither sampling nor evaluation ever enters sbi's unbounded rejection loops: see
:mod:`sbi_rope.metrics.calls`.
"""

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
    "CoverageCurve",
    "CoverageErrorScore",
    "Evaluation",
    "LPPScore",
    "acauc",
    "acauc_of",
    "central_levels",
    "coverage_curve",
    "coverage_curve_of",
    "draw_samples",
    "evaluate",
    "expected_coverage_error",
    "expected_coverage_error_of",
    "lpp",
    "mid_ranks",
]
