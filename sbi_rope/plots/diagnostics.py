"""Pictures of calibration, losses of a fine-tuning, and sizes of couplings."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from sbi_rope.coupling import Coupling
from sbi_rope.finetuning import History
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.evaluation import LEVEL, NOMINAL
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    SKY,
    VERMILLION,
    draw_calibrated_band,
    empty_figure,
    hide_frame,
    line_styles,
    new_figure,
)
from sbi_rope.settings import check, names_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "calibration_curves",
    "effective_sample_sizes",
    "finetuning_history",
    "ranks_by_estimate",
]

# The most parameters that are drawn, each in a panel.
MAX_PANELS = 6


def calibration_curves(evaluations: Mapping[str, Evaluation]) -> "Figure":
    r"""Draw the coverage of central credible intervals against their level.

    A posterior is under-confident where its curve is above the diagonal, and
    over-confident where it is below. At each level the band holds 95 % of the curves of
    calibrated posteriors of one parameter. For the average of several parameters it is
    wide enough, too. It is drawn for the smallest test set, whose size is :math:`n`:

    .. math:: \alpha \pm 1.96 \sqrt{\alpha (1 - \alpha) / n}

    Args:
        evaluations: The scores of each method, by name. Averages over parameters are
            drawn.

    Returns:
        The figure.
    """
    for name, one in evaluations.items():
        check(f"evaluations[{name!r}]", one, Evaluation)
    figure, axes = new_figure(7.4, 4.2)
    count = round(min(one.num_independent for one in evaluations.values()))
    label = f"calibrated, 95 % (n = {count})"
    draw_calibrated_band(axes, count, label=label)
    styles = line_styles(evaluations)
    for name, one in evaluations.items():
        curve = one.coverage.nanmean(dim=1).cpu()
        axes.plot(NOMINAL, curve, label=name, **styles[name])
    axes.set_xlabel("credible level")
    axes.set_ylabel("share of true parameters inside")
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
    check("evaluation", evaluation, Evaluation)
    names, count = evaluation.names, len(evaluation.names)
    if parameter_names is not None:
        names = names_of(parameter_names, count)
    shown = min(count, MAX_PANELS)
    columns = min(shown, 3)
    rows = math.ceil(shown / columns)
    figure = empty_figure(max(3.2 * columns, 4.2), 2.8 * rows)
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).flat
    for k, (axes, name) in enumerate(zip(panels, names[:shown], strict=False)):
        _draw_ranks(axes, evaluation, k)
        axes.set_xlabel(f"estimate of {name}")
        if k % columns == 0:
            axes.set_ylabel("rank of the true parameter")
    for axes in figure.axes[shown:]:
        axes.set_axis_off()
    return figure


def _draw_ranks(axes: "Axes", evaluation: Evaluation, k: int) -> None:
    found, tail = evaluation.dependence, (1 - LEVEL) / 2
    for low, high in ((0.0, tail), (1 - tail, 1.0)):
        axes.axhspan(low, high, color="0.88", lw=0)
    axes.plot(
        evaluation.estimates[:, k].cpu(),
        evaluation.ranks[:, k].cpu(),
        "o",
        color=BLUE,
        ms=3.5,
    )
    left, right = axes.get_xlim()
    edges = [edge for edge in found.edges[k].tolist() if not math.isnan(edge)]
    for edge in edges:
        axes.axvline(edge, color=GREY, lw=0.8)
    if edges:
        ends = [left, *edges, right]
        for share, start, stop in zip(
            found.shares[k].tolist(), ends, ends[1:], strict=False
        ):
            axes.text((start + stop) / 2, 1.03, f"{share:.0%}", ha="center", size=9)
    axes.set(xlim=(left, right), ylim=(0, 1))
    hide_frame(axes)


def finetuning_history(history: History) -> "Figure":
    """Draw the losses of a fine-tuning and mark the step that was kept.

    Args:
        history: The losses before each step and after the last, ``rope.history``.
            Without held-out pairs only the training loss is drawn.

    Returns:
        The figure.
    """
    check("history", history, History)
    training, validation = history.training_loss, history.validation_loss
    figure, axes = new_figure(6.0, 3.6)
    from matplotlib.ticker import MaxNLocator

    axes.plot(training, label="training pairs", color=BLUE, lw=1.2)
    kept = training
    if validation:
        axes.plot(validation, label="held-out pairs", color=VERMILLION, lw=1.2)
        kept = validation
    step = history.best_epoch
    suffix = " (the starting point)" if step == 0 else ""
    axes.axvline(step, color=GREY, lw=0.8)
    axes.plot(
        [step],
        [kept[step]],
        "o",
        color="black",
        ms=5,
        clip_on=False,
        label=f"kept: step {step}{suffix}",
    )
    axes.set_xlim(left=0, right=max(len(training) - 1, 1))
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("step")
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
    check("coupling", coupling, Coupling)
    sizes = coupling.effective_sample_size.detach().cpu().double()
    figure, axes = new_figure(6.0, 3.6)
    num_simulations = len(coupling.simulated)
    edges = torch.logspace(0, math.log10(max(num_simulations, 2)), 41).tolist()
    median = float(sizes.median())
    axes.hist(sizes.clamp(edges[0], edges[-1]), bins=edges, color=SKY)
    axes.axvline(median, color=BLUE, lw=1.8, label=f"median: {median:.3g} simulations")
    axes.axvline(
        num_simulations,
        color="black",
        ls="--",
        lw=1.2,
        label=f"all equal: $n_s$ = {num_simulations}",
    )
    axes.set_xscale("log")
    axes.set_xlabel("effective sample size (simulations)")
    axes.set_ylabel(f"observations (of {len(sizes)})")
    axes.legend(frameon=False, loc="upper left")
    return figure
