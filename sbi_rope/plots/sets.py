"""A credible set of one observation, and the set with a guarantee."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_rope.density import MixturePosterior
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.plots._figures import BLUE, GREY, ORANGE, empty_figure
from sbi_rope.plots._samples import (
    as_samples,
    central_interval,
    corner_legend,
    corner_panels,
    draw_marginal,
    with_margin,
)
from sbi_rope.sets import CredibleIntervals
from sbi_rope.settings import check
from sbi_rope.stacking import StackedPosterior

if TYPE_CHECKING:
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
    for axes, pair in corner_panels(figure, labels, limits, truth):
        if len(pair) == 1:
            draw_marginal(axes, samples[:, pair[0]], {"color": GREY})
            for name, found in intervals.items():
                for end in (found.low[pair[0]], found.high[pair[0]]):
                    axes.axvline(float(end), **STYLES[name], lw=1.8)
            continue
        for name, value in draws.items():
            colour, (x, y) = STYLES[name]["color"], value[:, pair].T.numpy()
            axes.scatter(x, y, s=5, color=colour, lw=0, rasterized=True)
    from matplotlib.lines import Line2D

    styles = {name: {**STYLES[name], "marker": "o", "ms": 4} for name in intervals}
    handles = [
        Line2D([], [], label=f"{100 * level:.4g} %, {name}", **style)
        for name, style in styles.items()
    ]
    corner_legend(figure, handles, truth)
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
