"""A credible set of one observation, and the set with a guarantee."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_rope.density import MixturePosterior
from sbi_rope.plots._figures import BLUE, GREY, ORANGE, empty_figure
from sbi_rope.plots._samples import (
    as_samples,
    central_interval,
    corner_legend,
    corner_panels,
    draw_marginal,
    with_margin,
)
from sbi_rope.stacking import StackedPosterior
from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.seeds import seeded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES: dict[str, dict[str, Any]] = {
    "of the posterior": {"color": BLUE, "ls": "-", "marker": "o", "ms": 4},
    "guaranteed": {"color": ORANGE, "ls": "--", "marker": "o", "ms": 4},
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

    The panels of pairs show parameters that are in the sets, the smaller set on the
    larger one. With three parameters or more, a panel shows the shadow of a set. The
    diagonal shows the intervals of each parameter, and draws of the posterior as a
    histogram. A set that a stack cannot guarantee is left out, with a warning.

    Args:
        posterior: A posterior of this package.
        x: An observation; the default x if None.
        theta: The true parameter, shape ``(d,)``, which is marked in black.
        level: The level of the sets and intervals.
        parameter_names: A label for each parameter; those of ``RoPE`` if None.
    """
    x = posterior._one_x(x)[0]
    found = {}
    for name in list(STYLES)[: 1 + isinstance(posterior, StackedPosterior)]:
        try:
            found[name] = posterior.credible_set(
                level, x, guaranteed=bool(found), num_samples=2000, seed=0
            )
        except InvalidInputError as error:
            if not found:
                raise
            warn_user(f"No set with a guarantee is drawn. {error}")
    with seeded(0):
        draws = posterior.sample((2000,), x, show_progress_bars=False)
        # A guaranteed set may reach further than the posterior.
        from_prior = posterior.prior.sample((2000,)).to(draws)
    mean = draws.mean(dim=0)
    points = torch.cat([from_prior, *(mean.lerp(draws, s) for s in (1.0, 2.0, 4.0))])
    samples = {name: points[one.contains(points)] for name, one in found.items()}
    samples["posterior"] = draws
    names = posterior.parameter_names if parameter_names is None else parameter_names
    members, truth, labels = as_samples(samples, theta, names)
    draws = members.pop("posterior")
    ends = {name: torch.stack([one.low, one.high]) for name, one in found.items()}
    shown = [central_interval(draws), *members.values(), *ends.values()]
    shown += [] if truth is None else [truth[None]]
    shown = torch.cat([one.to(draws) for one in shown]).nan_to_num(posinf=0, neginf=0)
    limits = with_margin(shown.amin(dim=0), shown.amax(dim=0))
    figure = empty_figure(2.0 * len(labels) + 0.8, 2.0 * len(labels) + 1.0)
    for axes, pair in corner_panels(figure, labels, limits, truth):
        if len(pair) == 1:
            draw_marginal(axes, draws[:, pair[0]], {"color": GREY})
            for name, end in ends.items():
                for value in end[:, pair[0]].tolist():
                    axes.axvline(value, **STYLES[name], lw=1.8, markevery=[])
            continue
        for name in sorted(found, key=lambda name: -len(members[name])):
            colour, columns = STYLES[name]["color"], members[name][:, pair].T.numpy()
            axes.scatter(*columns, s=5, color=colour, lw=0, rasterized=True)
    from matplotlib.lines import Line2D

    of = f"{100 * level:.4g} %"
    handles = [Line2D([], [], label=f"{of}, {k}", **STYLES[k]) for k in found]
    corner_legend(figure, handles, truth)
    return figure
