"""Pictures of discrepancies, calibration and diagnoses."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sbi_rope.diagnosis import Diagnosis
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.evaluation import NOMINAL
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    add_legend_above,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
    line_styles,
    new_figure,
    panel_grid,
)
from sbi_rope.plots._samples import central_interval, with_margin
from sbi_rope.utils.settings import check

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SUMMARIES = 20  # the most that are drawn


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
    shown = report.summaries[:MAX_SUMMARIES]
    figure = empty_figure(8.6, 1.5 + 0.3 * len(shown))
    size, shift, gain = figure.subplots(1, 3, width_ratios=[1.0, 1.1, 0.8], sharey=True)
    labels = {
        True: "a discrepancy is more probable than none",
        False: "no sign of a discrepancy",
    }
    for k, one in enumerate(shown):
        colour, label = BLUE if one.is_off else "0.65", labels.pop(one.is_off, None)
        style = {"color": colour, "lw": 1.8, "marker": "o", "ms": 5, "label": label}
        for axes, found in ((size, one.size), (shift, one.shift), (gain, one.gain)):
            unit = one.std if axes is shift else 1.0
            ends = [end / unit for end in (found.low, found.median, found.high)]
            axes.plot(ends, [k, k, k], **style, markevery=[1])
        beside, colour = shift.get_yaxis_transform(), "black" if one.is_off else GREY
        text = {"transform": beside, "color": colour, "va": "center"}
        shift.text(1.04, k, str(one.shift), **text)
    for axes, neutral in ((size, 0.0), (shift, 0.0), (gain, 1.0)):
        hide_frame(axes)
        axes.axvline(neutral, color=GREY, lw=0.8, zorder=0)
    for axes in (shift, gain):
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    size.set_yticks(range(len(shown)), [summary.name for summary in shown])
    size.set(xlim=(0.0, None), ylim=(len(shown) - 0.4, -0.6))
    size.set_xlabel("size, in sd\nof simulations")
    shift.set_xlabel("shift, in sd of simulations\n(beside it, in units of x)")
    gain.set_xlabel("gain")
    add_legend_above(figure, size)
    note = f"{report.num_pairs} calibration pairs, 95 % intervals, sorted by size"
    if left_out := len(report.summaries) - len(shown):
        note += f"; {left_out} summaries that are less off not shown"
    figure.supxlabel(note, fontsize="medium", color=GREY)
    return figure


def calibration_curves(evaluations: Mapping[str, Evaluation]) -> "Figure":
    r"""Draw the coverage of central credible intervals against their level.

    A posterior is under-confident where its curve is above the diagonal, and
    over-confident where it is below. At each level the band :math:`\alpha \pm 1.96
    \sqrt{\alpha (1 - \alpha) / n}` holds 95 % of the curves of calibrated posteriors of
    one parameter. For the average of several parameters it is wide enough, too. It is
    drawn for the smallest test set, whose size is :math:`n`.

    Args:
        evaluations: The scores of each method, by name. Averages over parameters are
            drawn.

    Returns:
        The figure.
    """
    figure, axes = new_figure(7.4, 4.2)
    count = round(min(one.num_independent for one in evaluations.values()))
    draw_calibrated_band(axes, count, label=f"calibrated, 95 % (n = {count})")
    for name, style in line_styles(evaluations).items():
        curve = evaluations[name].coverage.nanmean(dim=1).cpu()
        axes.plot(NOMINAL, curve, label=name, **style)
    axes.set(xlabel="credible level", ylabel="share of true parameters inside")
    axes.set_box_aspect(1)
    note = {"color": GREY, "size": "small", "transform": axes.transAxes}
    axes.text(0.03, 0.97, "under-confident", va="top", **note)
    axes.text(0.97, 0.03, "over-confident", ha="right", **note)
    # The legend is beside the axes, because a curve can be in any corner inside.
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return figure


def implied_parameters(diagnosis: Diagnosis) -> "Figure":
    """Draw the prior, and histograms of the parameters that a batch implies.

    The parameters that the batch implies are those of the simulations that it is
    coupled with. A dashed histogram shows the same for a batch that follows the prior.
    It differs from the prior because a coupling blurs.

    Args:
        diagnosis: What :func:`sbi_rope.diagnose` returns.

    Returns:
        The figure, with one panel for each parameter.
    """
    check("diagnosis", diagnosis, Diagnosis)
    names = diagnosis.parameter_names
    figure, panels = panel_grid(len(names), columns=4, width=3.4, height=2.7)
    figure.set_figheight(figure.get_figheight() + 0.5)
    lines = (
        ("implied by a batch of the prior", diagnosis.unshifted, GREY, "--"),
        ("implied by this batch", diagnosis.implied, BLUE, "-"),
    )
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        theta, prior = diagnosis.theta[:, k], diagnosis.prior[:, k]
        ends, whole = central_interval(prior[:, None])[:, 0], torch.aminmax(prior)
        # A prior without tails is shown as a whole.
        if whole.max - whole.min < 1.1 * (ends[1] - ends[0]):
            ends = torch.stack(whole)
        low, high = ends.tolist()
        axes.set(xlim=with_margin(*ends).tolist(), xlabel=name)
        axes.set_yticks([])
        options: dict[str, Any] = {"bins": np.linspace(low, high, 21), "density": True}
        # The outermost bins hold the tails, so that nothing is cut off.
        axes.hist(prior.clamp(low, high), color="0.85", label="prior", **options)
        options |= {"histtype": "step", "lw": 1.6}
        for label, weights, colour, line in lines:
            options |= {"label": label, "color": colour, "ls": line}
            axes.hist(theta.clamp(low, high), weights=weights, **options)
    panels[0].set_ylabel("density")
    add_legend_above(figure, panels[0])
    return figure
