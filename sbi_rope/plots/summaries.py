"""A picture of the summaries that a simulator gets wrong."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sbi_rope.discrepancy import DiscrepancyReport, Interval, SummaryDiscrepancy
from sbi_rope.plots._figures import BLUE, GREY, empty_figure, hide_frame
from sbi_rope.settings import check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["discrepancy"]

# The most summaries that are drawn.
MAX_SUMMARIES = 20
# The colour of summaries without a sign of a discrepancy.
NO_SIGN = "0.65"
SMALL = 10


def discrepancy(report: DiscrepancyReport) -> "Figure":
    r"""Draw how each summary of real observations differs from simulated ones.

    .. math:: x_o = \bar x + \text{shift} + \text{gain}\,(x_s - \bar x) + \text{error}

    There is a row with 95 % intervals for each of the first twenty summaries of the
    report, sorted by size. Summaries without a sign of a discrepancy come last and are
    grey. The first panel shows the size of the discrepancy, with the error included.
    The second shows the shift, which is zero without a discrepancy. All rows have one
    scale, the standard deviations of simulations, and the numbers in units of x are
    written beside them. The third shows the gain, which is one without a discrepancy.

    Args:
        report: What ``DiscrepancyNPE.report()`` returns.

    Returns:
        The figure.
    """
    check("report", report, DiscrepancyReport)
    shown = list(report.summaries[:MAX_SUMMARIES])
    figure = empty_figure(8.6, 1.5 + 0.3 * len(shown))
    widths = [1.0, 1.1, 0.95, 0.8]
    panels = figure.subplots(1, 4, width_ratios=widths, sharey=True)
    size, shift, numbers, gain = panels
    for position, summary in enumerate(shown):
        colour = BLUE if summary.is_off else NO_SIGN
        _interval(size, position, summary.size, colour)
        _interval(gain, position, summary.gain, colour)
        _interval(shift, position, summary.shift, colour, summary.std)
        _write(numbers, position, summary.shift, colour)
    numbers.set_axis_off()
    for axes, neutral in ((size, 0.0), (shift, 0.0), (gain, 1.0)):
        hide_frame(axes)
        axes.axvline(neutral, color=GREY, lw=0.8, zorder=0)
    for axes in (shift, gain):
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    names = [summary.name for summary in shown]
    size.set_yticks(range(len(shown)), names, fontsize=SMALL)
    size.set_ylim(len(shown) - 0.4, -0.6)
    size.set_xlim(left=0.0)
    size.set_xlabel("size, in sd\nof simulations")
    shift.set_xlabel("shift, in sd of simulations\n(beside it, in units of x)")
    gain.set_xlabel("gain")
    _legend(figure, shown)
    _note(figure, report)
    return figure


def _interval(
    axes: "Axes", position: int, interval: Interval, colour: str, unit: float = 1.0
) -> None:
    low, median, high = (
        value / unit for value in (interval.low, interval.median, interval.high)
    )
    axes.plot([low, high], [position] * 2, color=colour, lw=1.8, solid_capstyle="butt")
    axes.plot(median, position, "o", color=colour, markersize=5)


def _write(axes: "Axes", position: int, interval: Interval, colour: str) -> None:
    axes.annotate(
        str(interval),
        (0.0, position),
        xycoords=axes.get_yaxis_transform(),
        va="center",
        fontsize=SMALL,
        color=GREY if colour == NO_SIGN else "black",
    )


def _legend(figure: "Figure", shown: Sequence[SummaryDiscrepancy]) -> None:
    from matplotlib.lines import Line2D

    labels = {
        BLUE: "a discrepancy is more probable than none",
        NO_SIGN: "no sign of a discrepancy",
    }
    found = {BLUE if summary.is_off else NO_SIGN for summary in shown}
    handles = [
        Line2D([], [], color=colour, marker="o", markersize=5, lw=1.8, label=label)
        for colour, label in labels.items()
        if colour in found
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=2,
        frameon=False,
        fontsize=SMALL,
    )


def _note(figure: "Figure", report: DiscrepancyReport) -> None:
    parts = [f"{report.num_pairs} calibration pairs, 95 % intervals, sorted by size"]
    left_out = len(report.summaries) - MAX_SUMMARIES
    if left_out > 0:
        parts.append(f"{left_out} summaries that are less off not shown")
    if report.constant:
        parts.append(f"{len(report.constant)} the same in all simulations")
    figure.supxlabel("; ".join(parts), fontsize=SMALL, color=GREY)
