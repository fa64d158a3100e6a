"""A picture of the report of a stack."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from sbi_rope.metrics import Estimate
from sbi_rope.metrics.evaluation import NOMINAL
from sbi_rope.plots._figures import (
    BLUE,
    ORANGE,
    SKY,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
)
from sbi_rope.stacking import LearningCurve, StackingReport
from sbi_rope.utils.settings import check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALL, UNIT = 10, "nats a pair, theta in its own units"


def stacking_report(report: StackingReport) -> "Figure":
    """Draw out-of-fold scores and weights of candidates, and coverage of the stack.

    The first panel shows the mean log density of hold-out pairs under the candidates
    and the stack, with 95 % intervals. The stack is corrected for mass outside the
    prior; where this matters, it is shown without correction, too, because the
    candidates are not corrected. Scores far below the others are written beside an
    arrow. The second panel shows the weights. In the third, at each level the band
    holds 95 % of the coverage curves of calibrated posteriors. A learning curve is in a
    fourth panel, if there is one.

    Args:
        report: The report of a stack, ``posterior.report``.

    Returns:
        The figure.
    """
    check("report", report, StackingReport)
    curve, rows = report.learning_curve, report.as_rows()[::-1]
    top = max(1.2 + 0.28 * len(rows), 3.2)
    if curve is None:
        figure = empty_figure(9.4, top)
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
    _draw_scores(scores, report, rows)
    shares = [row["weight"] for row in rows]
    bars = weights.barh(range(len(rows)), shares, color=ORANGE)
    texts = [f"{share:.0%}" for share in shares]
    weights.bar_label(bars, texts, padding=3, fontsize=SMALL)
    weights.tick_params(axis="y", length=0, labelleft=False)
    weights.set_xlim(0, 1.35 * max(shares))
    weights.set_xlabel("weight in the stack", fontsize=SMALL)
    coverage = figure.add_subplot(places[0])
    draw_calibrated_band(coverage, round(report.held_out.num_independent))
    coverage.plot(NOMINAL, report.held_out.coverage.nanmean(dim=1).cpu(), color=BLUE)
    coverage.set(xlabel="credible level", ylabel="share of hold-out pairs inside")
    if curve is not None:
        _draw_learning_curve(figure.add_subplot(places[1]), curve)
    for axes in figure.axes:
        hide_frame(axes)
    return figure


def _draw_scores(
    axes: "Axes", report: StackingReport, rows: Sequence[dict[str, Any]]
) -> None:
    found = {
        row["candidate"]: Estimate(row["score"], row["score_low"], row["score_high"])
        for row in rows
    }
    # Scores four times as far below the best as the median is are drawn as arrows, so
    # that the others can be told apart.
    means = sorted(one.mean for one in found.values() if math.isfinite(one.mean))
    best, median = (means[-1], means[(len(means) - 1) // 2]) if means else (0.0, 0.0)
    floor = best - max(4.0 * (best - median), 1.0)
    # Arrows are at the edge: no interval of the others reaches beyond them.
    near = [one.low for one in found.values() if one.mean >= floor]
    edge = min([floor, *(low for low in near if math.isfinite(low))])
    for position, one in enumerate(found.values()):
        if one.mean >= floor:
            _draw_estimate(axes, position, one, fmt="o", color=SKY, markersize=5)
            continue
        axes.plot(edge, position, "<", color=SKY, markersize=7)
        text = f"{one.mean:.0f}" if math.isfinite(one.mean) else "zero density"
        beside: dict[str, Any] = {"xytext": (8, 0), "textcoords": "offset points"}
        axes.annotate(text, (edge, position), va="center", fontsize=SMALL, **beside)
    stacks = {"stack": report.held_out.lpp}
    uncorrected = report.held_out.mean(report.comparable_scores)
    if f"{uncorrected.mean:.2f}" != f"{report.held_out.lpp.mean:.2f}":
        # It is below the other, beside the candidates that it is compared with.
        stacks = {"stack, uncorrected": uncorrected, **stacks}
    for position, (name, one) in enumerate(stacks.items(), start=len(found)):
        face = BLUE if name == "stack" else "white"
        style = {"color": BLUE, "markerfacecolor": face, "markersize": 11}
        _draw_estimate(axes, position, one, fmt="*", **style)
    names = [*found, *stacks]
    axes.set_yticks(range(len(names)), names, fontsize=SMALL)
    axes.set_xlabel(f"log density of hold-out pairs,\n{UNIT}", fontsize=SMALL)


def _draw_estimate(axes: "Axes", position: int, one: Estimate, **style: Any) -> None:
    ends = [[one.mean - one.low], [one.high - one.mean]]
    xerr = ends if math.isfinite(one.low) else None
    axes.errorbar(one.mean, position, xerr=xerr, **style)


def _draw_learning_curve(axes: "Axes", curve: LearningCurve) -> None:
    means, low, high = torch.tensor([[*vars(one).values()] for one in curve.scores]).T
    style: dict[str, Any] = {"fmt": "o-", "color": BLUE, "capsize": 3}
    axes.errorbar(curve.num_pairs, means, yerr=[means - low, high - means], **style)
    axes.set(xscale="log", xlabel="pairs trained on")
    axes.set_ylabel(f"log density of hold-out pairs,\n{UNIT}")
    axes.set_xticks(curve.num_pairs, [str(n) for n in curve.num_pairs])
    axes.minorticks_off()
