r"""Pictures of posteriors, of their calibration, and of how RoPE got there.

Every function returns a matplotlib figure and shows nothing. matplotlib, and for
:func:`pair_plot` sbi's own plots, are imported when a function is called:
``pip install sbi-rope[benchmarks]``.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from sbi_rope._validation import check_batch, check_tensor
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics import CoverageCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "calibration_curves",
    "effective_sample_sizes",
    "finetuning_history",
    "pair_plot",
]

# Okabe and Ito's palette without its yellow, which is too light for lines on white.
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]
LINE_STYLES = ["-", "--", "-.", ":"]
GREY = "0.45"


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
    def weights(self) -> Tensor:
        """Mixture weights, shape ``(n_o, n_s)``."""
        ...

    @property
    def effective_sample_size(self) -> Tensor:
        """Effective number of simulations behind each row, shape ``(n_o,)``."""
        ...


def pair_plot(
    samples: Mapping[str, Tensor],
    theta: Tensor | None = None,
    *,
    parameter_names: Sequence[str] | None = None,
) -> "Figure":
    """Marginals and pairs of several posteriors of one observation.

    The axes hold the central 99 % of every posterior, and the true parameter: a few
    extreme samples do not squeeze the picture. Contours enclose 50 % and 90 % of the
    samples.

    Args:
        samples: Posterior samples by method name, each of shape ``(num_samples, k)``.
        theta: The true parameter, shape ``(k,)``, marked in black.
        parameter_names: One label for each parameter, with its unit.

    Returns:
        The figure, with one row and column for each parameter.

    Raises:
        InvalidInputError: If the shapes differ, or a sample is not finite.
        ImportError: If matplotlib or six is not installed.
    """
    draws, truth, names = _check_samples(samples, theta, parameter_names)
    pairplot = _import_pairplot()
    limits = _robust_limits(draws, truth)
    colours = [_line_style(index)["color"] for index in range(len(draws))]
    size = 2.2 * len(names) + 0.8
    figure, _ = pairplot(
        [value[_inside(value, limits)].numpy() for value in draws],
        points=None if truth is None else truth.reshape(1, -1).numpy(),
        limits=limits.tolist(),
        upper="contour",
        diag="hist",
        labels=names,
        figsize=(size, size),
        diag_kwargs=[_diagonal_style(colour) for colour in colours],
        upper_kwargs=[
            {"mpl_kwargs": {"colors": c}, "levels": [0.5, 0.9], "bins": 80}
            for c in colours
        ],
        fig_kwargs={"points_colors": ["black"]},
    )
    _add_legend(figure, list(samples), colours, truth)
    _forget(figure)
    return figure


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
        ImportError: If matplotlib is not installed.
    """
    _check_not_empty("curves", curves)
    figure, axes = _new_figure(7.4, 4.2)
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
    for index, (name, curve) in enumerate(curves.items()):
        axes.plot(
            curve.levels.cpu(), curve.average.cpu(), label=name, **_line_style(index)
        )
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
        ImportError: If matplotlib is not installed.
    """
    figure, axes = _new_figure(6.0, 3.6)
    from matplotlib.ticker import MaxNLocator

    training = torch.as_tensor(history.training_loss).cpu()
    validation = torch.as_tensor(history.validation_loss).cpu()
    axes.plot(training, label="training pairs", color=COLOURS[0], lw=1.2)
    kept = training
    if len(validation) > 0:
        axes.plot(validation, label="held-out pairs", color=COLOURS[1], lw=1.2)
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
        ImportError: If matplotlib is not installed.
    """
    figure, axes = _new_figure(6.0, 3.6)
    sizes = coupling.effective_sample_size.detach().cpu().double()
    num_simulations = coupling.weights.shape[1]
    edges = torch.logspace(0, math.log10(max(num_simulations, 2)), 41).tolist()
    median = float(sizes.median())
    axes.hist(sizes.clamp(edges[0], edges[-1]), bins=edges, color=COLOURS[5])
    axes.axvline(
        median, color=COLOURS[0], lw=1.8, label=f"median: {median:.3g} simulations"
    )
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


def _new_figure(width: float, height: float) -> "tuple[Figure, Axes]":
    """Return an empty figure that belongs to no window and needs no closing."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ImportError(
            "matplotlib is not installed. Run `pip install sbi-rope[benchmarks]`."
        ) from error

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _line_style(index: int) -> dict[str, Any]:
    return {
        "color": COLOURS[index % len(COLOURS)],
        "linestyle": LINE_STYLES[index % len(LINE_STYLES)],
        "linewidth": 1.8,
    }


def _diagonal_style(colour: str) -> dict[str, Any]:
    return {"mpl_kwargs": {"color": colour, "bins": 40, "density": True, "lw": 1.6}}


def _add_legend(
    figure: "Figure", names: Sequence[str], colours: Sequence[str], truth: Tensor | None
) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=colour, lw=1.8, label=name)
        for name, colour in zip(names, colours, strict=True)
    ]
    if truth is not None:
        handles.append(Line2D([], [], color="black", lw=1.2, label="truth"))
    figure.legend(handles=handles, loc="upper center", ncols=4, frameon=False)


def _check_samples(
    samples: Mapping[str, Tensor],
    theta: Tensor | None,
    parameter_names: Sequence[str] | None,
) -> tuple[list[Tensor], Tensor | None, list[str]]:
    """Return the samples and the truth on the CPU, and one name a parameter."""
    _check_not_empty("samples", samples)
    width = check_tensor("samples", next(iter(samples.values()))).shape[-1:]
    draws = [
        check_batch(f"samples[{name!r}]", value, width).detach().cpu()
        for name, value in samples.items()
    ]
    names = list(parameter_names or [f"$\\theta_{j + 1}$" for j in range(width[0])])
    if len(names) != width[0]:
        raise InvalidInputError(
            f"Expected `parameter_names` of length {width[0]}; got {len(names)}."
        )
    if theta is None:
        return draws, None, names
    check_batch("theta", check_tensor("theta", theta).reshape(1, -1), width)
    return draws, theta.detach().cpu().reshape(-1), names


def _check_not_empty(name: str, value: Mapping[str, Any]) -> None:
    if not value:
        raise InvalidInputError(f"Expected `{name}` with at least one entry; got none.")


def _robust_limits(draws: Sequence[Tensor], truth: Tensor | None) -> Tensor:
    """Union of the central 99 % of every sample set, with the truth, ``(k, 2)``."""
    ends = torch.tensor([0.005, 0.995], dtype=torch.float64)
    # Order statistics, not interpolated: a single extreme must not leak in.
    points = torch.cat(
        [
            value.double().quantile(ends, dim=0, interpolation="nearest")
            for value in draws
        ]
    )
    if truth is not None:
        points = torch.cat([points, truth.double().unsqueeze(0)])
    low, high = points.amin(dim=0), points.amax(dim=0)
    margin = 0.05 * (high - low).clamp(min=1e-6)
    return torch.stack([low - margin, high + margin], dim=1)


def _inside(value: Tensor, limits: Tensor) -> Tensor:
    return ((value >= limits[:, 0]) & (value <= limits[:, 1])).all(dim=1)


def _forget(figure: "Figure") -> None:
    """Take a figure that sbi made out of pyplot's list: it would never be freed."""
    from matplotlib import pyplot

    pyplot.close(figure)


def _import_pairplot() -> Any:
    try:
        from sbi.analysis import pairplot
    except ModuleNotFoundError as error:
        raise ImportError(
            f"The module `{error.name}`, which sbi's plots need, is not installed. "
            f"Run `pip install sbi-rope[benchmarks]`."
        ) from error
    return pairplot
