"""How well calibrated posteriors are, and how the steps of RoPE went."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from sbi_rope._validation import (
    check_attributes,
    check_batch,
    check_instance,
    check_integer,
    check_mapping,
    check_tensor,
)
from sbi_rope.errors import InvalidInputError, shown
from sbi_rope.metrics import CoverageCurve
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    SKY,
    VERMILLION,
    line_styles,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "CouplingLike",
    "FinetuningHistory",
    "calibration_curves",
    "effective_sample_sizes",
    "finetuning_history",
]


class FinetuningHistory(Protocol):
    """What :func:`finetuning_history` reads; :class:`sbi_rope.finetuning.History`."""

    @property
    def training_loss(self) -> Sequence[float]:
        """Loss before each step and after the last."""
        ...

    @property
    def validation_loss(self) -> Sequence[float]:
        """The same over held-out pairs; may be empty."""
        ...

    @property
    def best_step(self) -> int:
        """Step of the kept network; 0 is the starting point."""
        ...


class CouplingLike(Protocol):
    """What :func:`effective_sample_sizes` reads of a coupling."""

    @property
    def simulated(self) -> Tensor:
        """The embeddings of the simulations, shape ``(n_s, l)``."""
        ...

    @property
    def effective_sample_size(self) -> Tensor:
        """Effective number of simulations behind each row, shape ``(n_o,)``."""
        ...


def calibration_curves(curves: Mapping[str, CoverageCurve]) -> "Figure":
    r"""Empirical coverage of central credible intervals against their level.

    Above the diagonal a posterior is under-confident, below it over-confident. The band
    holds, level by level, 95 % of the curves of calibrated posteriors of one parameter
    and the smallest test set shown: :math:`\alpha \pm 1.96
    \sqrt{\alpha (1 - \alpha) / n}`. The average of several parameters varies no more.

    Args:
        curves: Coverage curves by method name, from
            :func:`sbi_rope.metrics.coverage_curve`; the average over parameters is
            drawn.

    Returns:
        The figure.

    Raises:
        InvalidInputError: If there is no curve.
        InvalidTypeError: If the curves are no dictionary, or one is no curve.
        ImportError: If matplotlib is not installed.
    """
    check_mapping("curves", curves, like="coverage curves")
    for name, curve in curves.items():
        check_instance(f"curves[{name!r}]", curve, CoverageCurve)
    figure, axes = new_figure(7.4, 4.2)
    count = min(curve.num_observations for curve in curves.values())
    alpha = torch.linspace(0.0, 1.0, 201)
    width = 1.96 * (alpha * (1.0 - alpha) / count).sqrt()
    axes.fill_between(
        alpha,
        (alpha - width).clamp(min=0.0),
        (alpha + width).clamp(max=1.0),
        color="0.85",
        label=f"calibrated, 95 % (n = {count})",
    )
    axes.plot([0, 1], [0, 1], color=GREY, lw=0.8)
    styles = line_styles(curves)
    for name, curve in curves.items():
        axes.plot(curve.levels.cpu(), curve.average.cpu(), label=name, **styles[name])
    axes.set(xlim=(0, 1), ylim=(0, 1), box_aspect=1)
    axes.set_xlabel("credible level")
    axes.set_ylabel("share of true parameters inside")
    note = {"color": GREY, "size": "small", "transform": axes.transAxes}
    axes.text(0.03, 0.97, "under-confident", va="top", **note)
    axes.text(0.97, 0.03, "over-confident", ha="right", **note)
    # Beside the axes: inside them every corner can hold a curve.
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return figure


def finetuning_history(history: FinetuningHistory) -> "Figure":
    """Losses of a fine-tuning, with the kept step marked.

    Args:
        history: Losses before each step and after the last, as
            :class:`sbi_rope.finetuning.History` holds them. Without a hold-out only the
            training loss is drawn.

    Returns:
        The figure.

    Raises:
        InvalidTypeError: If something is no history.
        InvalidInputError: If the losses are not finite, or ``best_step`` is no step.
        ImportError: If matplotlib is not installed.
    """
    training, validation = _checked_losses(history)
    figure, axes = new_figure(6.0, 3.6)
    from matplotlib.ticker import MaxNLocator

    axes.plot(training, label="training pairs", color=BLUE, lw=1.2)
    kept = training
    if len(validation) > 0:
        axes.plot(validation, label="held-out pairs", color=VERMILLION, lw=1.2)
        kept = validation
    step = history.best_step
    suffix = " (the starting point)" if step == 0 else ""
    axes.axvline(step, color=GREY, lw=0.8)
    axes.plot(
        [step],
        [float(kept[step])],
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


def effective_sample_sizes(coupling: CouplingLike) -> "Figure":
    r"""How many simulations stand behind each observation's posterior.

    The effective sample size of a row is :math:`1 / \sum_j \alpha_{ij}^2`: 1 if a
    single simulation carries all the weight, :math:`n_s` (marked) if all weigh the same
    and the posterior is the average over all simulations.

    Args:
        coupling: A coupling of observations to simulations.

    Returns:
        The figure: a histogram on a logarithmic axis.

    Raises:
        InvalidTypeError: If something is no coupling.
        InvalidInputError: If it has no simulations, or sizes that are not positive.
        ImportError: If matplotlib is not installed.
    """
    sizes = _checked_sizes(coupling)
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


def _checked_losses(history: FinetuningHistory) -> tuple[Tensor, Tensor]:
    check_attributes(
        "history",
        history,
        ["training_loss", "validation_loss", "best_step"],
        like="the history of a fine-tuning",
    )
    training = _losses("training_loss", history.training_loss)
    validation = _losses("validation_loss", history.validation_loss)
    kept = validation if len(validation) else training
    if not len(kept):
        raise InvalidInputError(
            "Expected `history.training_loss` with at least one loss; got none."
        )
    check_integer(
        "history.best_step", history.best_step, minimum=0, maximum=len(kept) - 1
    )
    return training, validation


def _losses(name: str, values: Sequence[float]) -> Tensor:
    try:
        losses = torch.as_tensor(values).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        losses = torch.empty((), dtype=torch.bool)
    if losses.ndim != 1 or losses.is_complex() or losses.dtype == torch.bool:
        raise InvalidInputError(
            f"Expected `history.{name}` to be a list of numbers; got {shown(values)}."
        )
    return check_batch(f"history.{name}", losses, (), allow_empty=True)


def _checked_sizes(coupling: CouplingLike) -> Tensor:
    check_attributes(
        "coupling",
        coupling,
        ["simulated", "effective_sample_size"],
        like="a coupling of observations to simulations",
    )
    name = "coupling.effective_sample_size"
    sizes = check_batch(name, coupling.effective_sample_size, ())
    if not (sizes > 0).all():
        raise InvalidInputError(
            f"Expected `{name}` to be positive; got {float(sizes.min())}."
        )
    simulated = check_tensor("coupling.simulated", coupling.simulated)
    if not simulated.ndim or not len(simulated):
        raise InvalidInputError(
            "Expected `coupling.simulated` of shape (n_s, l) with n_s >= 1; got "
            f"{tuple(simulated.shape)}."
        )
    return sizes.detach().cpu().double()
