"""A picture of the report of a stack."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sbi_rope._validation import check_instance
from sbi_rope.metrics import CoverageCurve
from sbi_rope.plots._figures import (
    BLUE,
    ORANGE,
    SKY,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
)
from sbi_rope.stacking import LearningCurve, StackingReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "draw_coverage",
    "draw_learning_curve",
    "draw_scores",
    "draw_weights",
    "stacking_report",
]

# The most candidates that are drawn.
MAX_CANDIDATES = 12


def stacking_report(report: StackingReport) -> "Figure":
    """Draw held-out scores of the candidates, weights, coverage and learning curve.

    The first panel shows the mean log score of the best candidates and of the stack, on
    pairs that they were not trained on, in nats with theta in its own units, and one
    standard error to each side. No score is corrected for mass outside the prior. The
    second panel shows the weight of each method. The third shows the coverage of the
    stack on held-out pairs. At each level its band holds 95 % of the curves of
    calibrated posteriors. If a learning curve was computed, a fourth panel shows the
    score of the stack against the number of pairs that it was trained on.

    Args:
        report: The report of a stack, ``posterior.report``.

    Returns:
        The figure.

    Raises:
        InvalidTypeError: If the argument is no report.
        ImportError: If matplotlib is not installed.
    """
    check_instance("report", report, StackingReport)
    curve = report.learning_curve
    widths = [1.7, 1.2, 1.0] if curve is None else [1.7, 1.2, 1.0, 1.0]
    figure = empty_figure(11.0 if curve is None else 14.0, 3.8)
    panels = figure.subplots(1, len(widths), width_ratios=widths)
    draw_scores(panels[0], report)
    draw_weights(panels[1], report.family_weights)
    draw_coverage(panels[2], report.coverage)
    if curve is not None:
        draw_learning_curve(panels[3], curve)
    for axes in panels:
        hide_frame(axes)
    return figure


def draw_scores(axes: "Axes", report: StackingReport) -> None:
    """Draw the held-out scores of the best candidates and of the stack."""
    finite = [row for row in report.as_rows() if row["score"] > -float("inf")]
    rows = finite[:MAX_CANDIDATES][::-1]
    for position, row in enumerate(rows):
        axes.errorbar(
            row["score"],
            position,
            xerr=row["standard_error"],
            fmt="o",
            color=SKY,
            markersize=4,
        )
    score, error = report.comparable_score
    axes.errorbar(
        score, len(rows), xerr=error, fmt="*", color=BLUE, markersize=10, capsize=3
    )
    axes.set_yticks(
        range(len(rows) + 1), [*(row["candidate"] for row in rows), "stack"], fontsize=8
    )
    left_out = len(report.as_rows()) - len(rows)
    note = f" ({left_out} lower ones not shown)" if left_out else ""
    axes.set_xlabel(
        f"log score of held-out pairs{note},\nnats a pair, theta in its own units",
        fontsize=9,
    )


def draw_weights(axes: "Axes", weights: Mapping[str, float]) -> None:
    """Draw the weight of each method."""
    names = list(weights)[::-1]
    bars = axes.barh(range(len(names)), [weights[name] for name in names], color=ORANGE)
    axes.bar_label(bars, [f"{weights[name]:.0%}" for name in names], padding=3)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set(xlim=(0, 1.15 * max(weights.values())), xlabel="weight in the stack")


def draw_coverage(axes: "Axes", curve: CoverageCurve) -> None:
    """Draw the share of held-out pairs inside intervals of each level."""
    draw_calibrated_band(axes, curve.num_observations)
    axes.plot(curve.levels.cpu(), curve.average.cpu(), color=BLUE)
    axes.set(xlabel="credible level", ylabel="share of held-out pairs inside")


def draw_learning_curve(axes: "Axes", curve: LearningCurve) -> None:
    """Draw the score of the stack against the number of pairs."""
    axes.errorbar(
        curve.num_pairs,
        curve.scores,
        yerr=curve.standard_errors,
        fmt="o-",
        color=BLUE,
        capsize=3,
    )
    axes.set(
        xscale="log",
        xlabel="pairs trained on",
        ylabel="held-out score, nats a pair,\ntheta in its own units",
    )
    axes.set_xticks(curve.num_pairs, [str(n) for n in curve.num_pairs])
    axes.minorticks_off()
