"""A picture of the report of a stack."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sbi_rope.metrics import CoverageCurve
from sbi_rope.plots._figures import (
    BLUE,
    ORANGE,
    SKY,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
)
from sbi_rope.settings import check
from sbi_rope.stacking import LearningCurve, StackingReport
from sbi_rope.stacking.words import differs

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
# How far the axis of scores reaches below the best, in distances of the median to it.
REACH = 4.0
SMALL = 10


def stacking_report(report: StackingReport) -> "Figure":
    """Draw held-out scores of the candidates, weights, coverage and learning curve.

    The first panel shows the mean log score of the best candidates and of the stack, on
    pairs that they were not trained on, in nats with theta in its own units, and one
    standard error to each side. The score of the stack is corrected for mass outside
    the prior. If it is another without correction, this is shown too, because those of
    the candidates are not corrected. A score far below the others is written beside an
    arrow. The second panel shows the weights of the same candidates. The third shows
    the coverage of the stack on held-out pairs. At each level its band holds 95 % of
    the curves of calibrated posteriors. If a learning curve was computed, a fourth
    panel shows the score of the stack against the number of pairs that it was trained
    on.

    Args:
        report: The report of a stack, ``posterior.report``.

    Returns:
        The figure.
    """
    check("report", report, StackingReport)
    curve = report.learning_curve
    shown = report.as_rows()[:MAX_CANDIDATES]
    top = 1.2 + 0.28 * len(shown)
    if curve is None:
        figure = empty_figure(9.4, max(top, 3.2))
        grid = figure.add_gridspec(1, 3, width_ratios=[1.5, 0.8, 1.2])
        places = [grid[0, 2]]
    else:
        # Four panels beside each other could not be read on a page.
        figure = empty_figure(8.2, top + 3.2)
        heights = [top, 3.2]
        grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1], height_ratios=heights)
        below = grid[1, :].subgridspec(1, 2)
        places = [below[0], below[1]]
    scores = figure.add_subplot(grid[0, 0])
    weights = figure.add_subplot(grid[0, 1], sharey=scores)
    draw_scores(scores, report)
    _draw_weights_beside(weights, report)
    draw_coverage(figure.add_subplot(places[0]), report.coverage)
    if curve is not None:
        draw_learning_curve(figure.add_subplot(places[1]), curve)
    for axes in figure.axes:
        hide_frame(axes)
    return figure


def draw_scores(axes: "Axes", report: StackingReport) -> None:
    """Draw the held-out scores of the best candidates and of the stack."""
    rows = report.as_rows()
    shown = rows[:MAX_CANDIDATES][::-1]
    floor = _floor([row["score"] for row in shown])
    # Arrows are at the edge: no error bar of the others reaches beyond them.
    near = [row for row in shown if row["score"] >= floor]
    edge = min([floor, *(row["score"] - row["standard_error"] for row in near)])
    for position, row in enumerate(shown):
        if row["score"] >= floor:
            axes.errorbar(
                row["score"],
                position,
                xerr=row["standard_error"],
                fmt="o",
                color=SKY,
                markersize=5,
            )
        else:
            _draw_arrow(axes, position, row["score"], edge)
    names = [row["candidate"] for row in shown]
    stacks = {"stack": report.score}
    if differs(report):
        # It is below the other, beside the candidates that it is compared with.
        stacks = {"stack, uncorrected": report.comparable_score, **stacks}
    for position, (name, (score, error)) in enumerate(stacks.items(), start=len(names)):
        axes.errorbar(
            score,
            position,
            xerr=error,
            fmt="*",
            color=BLUE,
            markerfacecolor=BLUE if name == "stack" else "white",
            markersize=11,
            capsize=3,
        )
    names += stacks
    axes.set_yticks(range(len(names)), names, fontsize=SMALL)
    left_out = len(rows) - len(shown)
    note = f" ({left_out} lower ones not shown)" if left_out else ""
    axes.set_xlabel(
        f"log score of held-out pairs{note},\nnats a pair, theta in its own units",
        fontsize=SMALL,
    )


def _floor(scores: Sequence[float]) -> float:
    """Return the score below which an arrow is drawn, so that others can be told apart.

    It is four times as far below the best score as the median is.
    """
    ordered = sorted(score for score in scores if math.isfinite(score)) or [0.0]
    best, middle = ordered[-1], ordered[(len(ordered) - 1) // 2]
    return best - max(REACH * (best - middle), 1.0)


def _draw_arrow(axes: "Axes", position: int, score: float, edge: float) -> None:
    """Draw an arrow for a score that is far to the left, with its number."""
    axes.plot(edge, position, "<", color=SKY, markersize=7)
    text = f"{score:.0f}" if math.isfinite(score) else "zero density"
    axes.annotate(
        text,
        (edge, position),
        xytext=(8, 0),
        textcoords="offset points",
        va="center",
        fontsize=SMALL,
    )


def _draw_weights_beside(axes: "Axes", report: StackingReport) -> None:
    """Draw the weights of the candidates that the scores are drawn of, in their rows.

    The weight of those that are not shown is stated below.
    """
    rows = report.as_rows()
    weights = [row["weight"] for row in rows[:MAX_CANDIDATES]][::-1]
    bars = axes.barh(range(len(weights)), weights, color=ORANGE)
    axes.bar_label(bars, [f"{w:.0%}" for w in weights], padding=3, fontsize=SMALL)
    axes.tick_params(axis="y", length=0, labelleft=False)
    others = sum(row["weight"] for row in rows[MAX_CANDIDATES:])
    note = f"\n({others:.0%} on those not shown)" if rows[MAX_CANDIDATES:] else ""
    axes.set_xlim(0, 1.25 * max(weights))
    axes.set_xlabel(f"weight in the stack{note}", fontsize=SMALL)


def draw_weights(axes: "Axes", weights: Mapping[str, float]) -> None:
    """Draw the weight of each method."""
    names = list(weights)[::-1]
    bars = axes.barh(range(len(names)), [weights[name] for name in names], color=ORANGE)
    axes.bar_label(bars, [f"{weights[name]:.0%}" for name in names], padding=3)
    axes.set_yticks(range(len(names)), names, fontsize=SMALL)
    axes.set(xlim=(0, 1.15 * max(weights.values())), xlabel="weight in the stack")


def draw_coverage(axes: "Axes", curve: CoverageCurve) -> None:
    """Draw the share of held-out pairs inside intervals of each level."""
    draw_calibrated_band(axes, curve.num_observations)
    axes.set_box_aspect(None)  # as high as the panels beside it
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
