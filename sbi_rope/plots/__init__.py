"""Pictures of posteriors, of their calibration, and of the steps of RoPE.

Every function returns a matplotlib figure and does not show it. matplotlib is imported
when a function is called. Install it with ``pip install sbi-rope[benchmarks]``.
"""

from sbi_rope.plots.diagnostics import (
    calibration_curves,
    discrepancy,
    implied_parameters,
)
from sbi_rope.plots.posteriors import credible_set, overview, pair_plot
from sbi_rope.plots.stacking import stacking_report

__all__ = [
    "calibration_curves",
    "credible_set",
    "discrepancy",
    "implied_parameters",
    "overview",
    "pair_plot",
    "stacking_report",
]
