"""Pictures of discrepancies, calibration, fine-tuning and couplings."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sbi_rope.coupling import Coupling
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.evaluation import LEVEL, NOMINAL
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    SKY,
    VERMILLION,
    add_legend_above,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
    line_styles,
    new_figure,
    panel_grid,
)
from sbi_rope.plots._samples import as_drawn, central_interval
from sbi_rope.rope.finetuning import History
from sbi_rope.utils.settings import names_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The most parameters, series and summaries that are drawn.
MAX_PANELS, MAX_SUMMARIES = 6, 20


def real_and_simulated(
    x_o: Tensor, x_s: Tensor, *, x_names: Sequence[str] | None = None
) -> "Figure":
    """Draw real observations in blue, and simulations with the same parameters.

    Args:
        x_o: Real observations, shape ``(n, l)``.
        x_s: Simulations with the parameters of the real observations, same shape.
        x_names: A name for each of the l entries, of which a histogram of their central
            99 % is drawn. If None, the first six observations are drawn as series.

    Returns:
        The figure.
    """
    x_o = as_drawn("x_o", x_o, np.shape(x_o)[-1:])
    x_s = as_drawn("x_s", x_s, x_o.shape[1:], rows=len(x_o))
    if x_names is None:
        count = min(len(x_o), MAX_PANELS)
        figure, panels = panel_grid(count, columns=3, width=3.2, height=2.2)
        for axes, real, simulated in zip(panels, x_o, x_s, strict=False):
            axes.plot(simulated, color=VERMILLION, lw=1.2, label="simulated")
            axes.plot(real, color=BLUE, lw=1.2, label="real")
    else:
        figure, panels = panel_grid(len(x_names), columns=4, width=2.6, height=2.4)
        ends = central_interval(torch.cat([x_o, x_s])).T.tolist()
        style = {"bins": 40, "density": True, "histtype": "stepfilled", "alpha": 0.45}
        for k, (axes, name) in enumerate(zip(panels, x_names, strict=True)):
            style["range"] = ends[k]
            axes.hist(x_s[:, k], color=VERMILLION, label="simulated", **style)
            axes.hist(x_o[:, k], color=BLUE, label="real", **style)
            axes.set(xlabel=name, yticks=[])
    add_legend_above(figure, panels[0])
    return figure


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
    note = {"color": GREY, "size": "small", "transform": axes.transAxes}
    axes.text(0.03, 0.97, "under-confident", va="top", **note)
    axes.text(0.97, 0.03, "over-confident", ha="right", **note)
    # The legend is beside the axes, because a curve can be in any corner inside.
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return figure


def ranks_by_estimate(
    evaluation: Evaluation, *, parameter_names: Sequence[str] | None = None
) -> "Figure":
    r"""Draw the ranks of true parameters against the posterior means.

    A rank of 0 is below all samples of the posterior, and one of 1 above all. If the
    posterior is calibrated, ranks are spread evenly over the whole height, whatever the
    estimate is. Parameters in the grey bands are outside their intervals. Lines divide
    the thirds of the estimates, and the share inside the intervals is written above
    each. There is a panel for each of the first six parameters.

    Args:
        evaluation: The scores of a posterior, or ``posterior.report.held_out`` of a
            stack.
        parameter_names: A name for each parameter; those of the evaluation if None.

    Returns:
        The figure.
    """
    names = parameter_names or evaluation.names
    names = names_of(names, len(evaluation.names))[:MAX_PANELS]
    estimates, ranks = evaluation.estimates.cpu(), evaluation.ranks.cpu()
    found, tail, count = evaluation.dependence, (1 - LEVEL) / 2, len(names)
    figure, panels = panel_grid(count, columns=3, width=3.2, height=2.8, sharey=True)
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.axhspan(0.0, tail, color="0.88", lw=0)
        axes.axhspan(1 - tail, 1.0, color="0.88", lw=0)
        axes.plot(estimates[:, k], ranks[:, k], "o", color=BLUE, ms=3.5)
        left, right = axes.get_xlim()
        axes.set(xlim=(left, right), ylim=(0, 1), xlabel=f"estimate of {name}")
        if k % 3 == 0:
            axes.set_ylabel("rank of the true parameter")
        low, high = found.edges[k].tolist()
        if low != low:  # NaN, as the parameter is not known anywhere
            continue
        axes.vlines([low, high], 0, 1, color=GREY, lw=0.8)
        centres = ((left + low) / 2, (low + high) / 2, (high + right) / 2)
        for x, share in zip(centres, found.shares[k].tolist(), strict=True):
            axes.text(x, 1.03, f"{share:.0%}", ha="center", size=9)
    return figure


def finetuning_history(history: History) -> "Figure":
    """Draw the losses of a fine-tuning and mark the step that was kept.

    Args:
        history: The losses before each step and after the last, ``rope.history``.
            Without held-out pairs only the training loss is drawn.

    Returns:
        The figure.
    """
    figure, axes = new_figure(6.0, 3.6)
    loss = history.training_loss
    axes.plot(loss, label="training pairs", color=BLUE, lw=1.2)
    if history.validation_loss:
        loss = history.validation_loss
        axes.plot(loss, label="held-out pairs", color=VERMILLION, lw=1.2)
    step = history.best_epoch
    kept = f"kept: step {step}{'' if step else ' (the starting point)'}"
    axes.axvline(step, color=GREY, lw=0.8)
    axes.plot(step, loss[step], "o", color="black", ms=5, clip_on=False, label=kept)
    axes.set(xlim=(0, max(len(loss) - 1, 1)), ylim=(0, None), xlabel="step")
    axes.locator_params("x", integer=True)
    axes.set_ylabel("mean distance to the target\n(units of the embedding)")
    axes.legend(frameon=False)
    return figure


def effective_sample_sizes(coupling: Coupling) -> "Figure":
    r"""Draw how many simulations contribute to the posterior of each observation.

    The effective sample size of observation :math:`i` is
    :math:`1 / \sum_j \alpha_{ij}^2`. It is 1 if a single simulation has all the weight,
    and the number of simulations :math:`n_s` if all have the same weight. A line marks
    :math:`n_s`.

    Args:
        coupling: A coupling of observations to simulations, ``posterior.coupling``.

    Returns:
        The figure, a histogram on a logarithmic axis.
    """
    sizes = coupling.effective_sample_size.detach().cpu().double()
    n_s, median = len(coupling.simulated), float(sizes.median())
    figure, axes = new_figure(6.0, 3.6)
    edges = np.geomspace(1, max(n_s, 2), 41).tolist()
    axes.hist(sizes.clamp(edges[0], edges[-1]), bins=edges, color=SKY)
    axes.axvline(median, color=BLUE, lw=1.8, label=f"median: {median:.3g} simulations")
    label = f"all equal: $n_s$ = {n_s}"
    axes.axvline(n_s, color="black", ls="--", lw=1.2, label=label)
    axes.set(xscale="log", xlabel="effective sample size (simulations)")
    axes.set_ylabel(f"observations (of {len(sizes)})")
    axes.legend(frameon=False, loc="upper left")
    return figure
