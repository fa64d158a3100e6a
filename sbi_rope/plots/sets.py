"""A credible set of one observation, and the set with a guarantee."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.mixture import MixturePosterior
from sbi_rope.plots._figures import BLUE, GREY, ORANGE, empty_figure, hide_frame
from sbi_rope.plots._samples import (
    as_samples,
    central_interval,
    draw_marginal,
    with_margin,
)
from sbi_rope.sets import CredibleIntervals
from sbi_rope.settings import check
from sbi_rope.stacking import StackedPosterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["credible_set"]

NUM_SAMPLES = 2000
CREDIBLE, GUARANTEED = "of the posterior", "guaranteed"
STYLES: dict[str, dict[str, Any]] = {
    CREDIBLE: {"color": BLUE, "linestyle": "-"},
    GUARANTEED: {"color": ORANGE, "linestyle": "--"},
}


def credible_set(
    posterior: MixturePosterior,
    x: Tensor | None = None,
    theta: Tensor | None = None,
    *,
    level: float = 0.9,
    parameter_names: Sequence[str] | None = None,
) -> "Figure":
    """Draw the credible set of an observation, and of a stack that with a guarantee.

    The panels of pairs show parameters that are in the sets. The larger set is drawn
    first, so that the smaller one lies on it. With three parameters or more, a panel
    shows the shadow of a set, in which the other parameters have any value of the set.
    The diagonal shows the intervals of each parameter by itself, and draws of the
    posterior as a histogram. Of a stack that cannot guarantee the level, because it has
    too few pairs or their labels are not exact, the credible set alone is drawn, with a
    warning.

    Args:
        posterior: A posterior of this package.
        x: An observation, from the batch if there is one; the default x if None.
        theta: The true parameter, shape ``(d,)``, which is marked in black.
        level: The level of the sets and intervals.
        parameter_names: A label for each parameter, with its unit. If None, the names
            that ``RoPE`` was given.

    Returns:
        The figure, with d rows and columns and the intervals on the diagonal.

    Raises:
        InvalidInputError: If the posterior is another one, or an argument does not fit.
    """
    check("posterior", posterior, MixturePosterior)
    options: dict[str, Any] = {"num_samples": NUM_SAMPLES, "seed": 0}
    sets = {CREDIBLE: posterior.credible_set(level, x, **options)}
    intervals = {CREDIBLE: posterior.credible_intervals(level, x, **options)}
    if isinstance(posterior, StackedPosterior):
        options["guaranteed"] = True
        try:
            sets[GUARANTEED] = posterior.credible_set(level, x, **options)
            intervals[GUARANTEED] = posterior.credible_intervals(level, x, **options)
        except InvalidInputError as error:  # the same arguments were good before
            warn_user(f"No set with a guarantee is drawn. {error}")
    points = torch.cat([found.draws for found in sets.values()])
    # In the order in which they are drawn, the largest first.
    members = {
        name: points[found.contains(points)]
        for name, found in sorted(sets.items(), key=lambda item: -item[1].volume)
    }
    draws, truth, labels = as_samples(
        {"posterior": sets[CREDIBLE].draws, **members},
        theta,
        posterior.parameter_names if parameter_names is None else parameter_names,
    )
    return _drawn(draws, intervals, truth, labels, level=level)


def _drawn(
    draws: dict[str, Tensor],
    intervals: Mapping[str, CredibleIntervals],
    truth: Tensor | None,
    labels: Sequence[str],
    *,
    level: float,
) -> "Figure":
    dim = len(labels)
    limits = _limits(draws, intervals, truth)
    samples = draws.pop("posterior")
    figure = empty_figure(2.0 * dim + 0.8, 2.0 * dim + 1.0)
    for row in range(dim):
        for column in range(row + 1):
            axes = figure.add_subplot(dim, dim, row * dim + column + 1)
            hide_frame(axes)
            axes.set_xlim(*limits[:, column].tolist())
            if row == column:
                _draw_intervals(axes, samples[:, row], intervals, truth, row)
            else:
                axes.set_ylim(*limits[:, row].tolist())
                _draw_sets(axes, draws, truth, [column, row])
            axes.tick_params(labelbottom=row == dim - 1, labelleft=column == 0)
            if row == dim - 1:
                axes.set_xlabel(labels[column])
            if column == 0 and row > 0:
                axes.set_ylabel(labels[row])
    _add_legend(figure, intervals, truth, level=level)
    return figure


def _limits(
    draws: Mapping[str, Tensor],
    intervals: Mapping[str, CredibleIntervals],
    truth: Tensor | None,
) -> Tensor:
    """Return limits of the axes that hold sets, intervals and the truth, ``(2, d)``."""
    spans = [central_interval(draws["posterior"])]
    spans += [
        torch.stack([value.amin(dim=0), value.amax(dim=0)])
        for name, value in draws.items()
        if name != "posterior" and len(value)
    ]
    spans += [
        torch.stack([one.low, one.high]).to(spans[0]) for one in intervals.values()
    ]
    if truth is not None:
        spans.append(truth.expand(2, -1))
    low, high = torch.stack(spans).nan_to_num(posinf=0.0, neginf=0.0).unbind(dim=1)
    return with_margin(low.amin(dim=0), high.amax(dim=0))


def _draw_intervals(
    axes: "Axes",
    samples: Tensor,
    intervals: Mapping[str, CredibleIntervals],
    truth: Tensor | None,
    number: int,
) -> None:
    draw_marginal(axes, samples, {"color": GREY})
    for name, found in intervals.items():
        for end in (found.low[number], found.high[number]):
            axes.axvline(float(end), **STYLES[name], lw=1.8)
    axes.spines["left"].set_visible(False)
    axes.set_yticks([])
    axes.set_ylim(bottom=0)
    if truth is not None:
        axes.axvline(float(truth[number]), color="black", lw=1.2)


def _draw_sets(
    axes: "Axes", members: Mapping[str, Tensor], truth: Tensor | None, pair: list[int]
) -> None:
    for name, value in members.items():
        axes.scatter(
            *value[:, pair].T.numpy(),
            s=5,
            color=STYLES[name]["color"],
            lw=0,
            rasterized=True,
        )
    if truth is not None:
        axes.plot(*truth[pair].tolist(), "o", color="black", ms=4, zorder=5)


def _add_legend(
    figure: "Figure",
    intervals: Mapping[str, CredibleIntervals],
    truth: Tensor | None,
    *,
    level: float,
) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [],
            [],
            **STYLES[name],
            marker="o",
            ms=4,
            label=f"{100 * level:.4g} %, {name}",
        )
        for name in intervals
    ]
    if truth is not None:
        handles.append(
            Line2D([], [], color="black", lw=1.2, marker="o", ms=4, label="truth")
        )
    # The legend is in the empty half of the figure, or above a single panel.
    place = "upper right" if len(figure.axes) > 1 else "outside upper center"
    figure.legend(handles=handles, loc=place, frameon=False)
