r"""Scores of a posterior on observations whose true parameters are known.

:func:`evaluate` draws samples once and returns all scores of any sbi posterior that has
``sample_batched`` and ``log_prob_batched``. The test set consists of ``theta``, shape
``(n, d)``, and ``x``, shape ``(n, *event_shape)``, both on the device of the posterior.

The scores of calibration are also functions of ranks and levels, which need no
posterior: ``acauc_of(central_levels(mid_ranks(samples, theta)))``.

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
from sbi_rope.metrics.density import LPPScore, lpp
from sbi_rope.metrics.evaluation import Evaluation, evaluate

__all__ = [
    "ACAUCScore",
    "CoverageByEstimate",
    "CoverageCurve",
    "CoverageErrorScore",
    "Evaluation",
    "LPPScore",
    "acauc_of",
    "central_levels",
    "coverage_by_estimate",
    "coverage_curve_of",
    "draw_samples",
    "evaluate",
    "expected_coverage_error_of",
    "lpp",
    "mid_ranks",
]
