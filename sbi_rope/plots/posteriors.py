"""Posteriors and credible sets of one observation, and how RoPE makes a posterior."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.density import MixturePosterior
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    ORANGE,
    VERMILLION,
    empty_figure,
    hide_frame,
)
from sbi_rope.plots._samples import (
    TRUTH,
    as_drawn,
    as_posteriors,
    as_samples,
    central_interval,
    corner_legend,
    corner_panels,
    draw_contours,
    draw_marginal,
    draw_posteriors,
    set_up_panel,
    with_margin,
)
from sbi_rope.stacking import StackedPosterior
from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.seeds import seeded

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DOTS: dict[str, Any] = {"lw": 0, "rasterized": True}
STAR: dict[str, Any] = {"marker": "*", "ms": 15, "mec": "white", "color": "black"}
ARROW = {"arrowstyle": "-|>", "color": "black", "lw": 1.6}
# The most simulations and observations that are drawn. More would run together.
MAX_SIMULATED, MAX_REAL = 1000, 250
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 11}
SETS: dict[str, dict[str, Any]] = {
    "of the posterior": {"color": BLUE, "ls": "-", "marker": "o", "ms": 4},
    "guaranteed": {"color": ORANGE, "ls": "--", "marker": "o", "ms": 4},
}


def pair_plot(
    samples: Mapping[str, Tensor],
    theta: Tensor | None = None,
    *,
    parameter_names: Sequence[str] | None = None,
    prior: Tensor | None = None,
) -> "Figure":
    """Draw the marginals and pairs of several posteriors of one observation.

    Contours enclose 50 % and 90 % of the samples. The axes hold the true parameter and
    the central 99 % of every posterior, but reach beyond the prior by at most its
    width. The legend says which share of a posterior is outside.

    Args:
        samples: Posterior samples by method name, each of shape ``(num_samples, d)``.
        theta: The true parameter, shape ``(d,)``, which is marked in black.
        parameter_names: A label for each parameter, with its unit.
        prior: Samples of the prior, shape ``(n, d)``. Their central 99 % is shaded.

    Returns:
        The figure, with d rows and columns and the marginals on the diagonal.
    """
    drawn = as_posteriors(samples, theta, parameter_names, prior)
    draws, truth, names, limits, ends = drawn
    figure, panels = corner_panels(names, limits, truth)
    for axes, shown in panels:
        draw_posteriors(axes, draws, ends, shown)
    corner_legend(figure, panels[0][0].get_legend_handles_labels()[0])
    return figure


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
    for name in list(SETS)[: 1 + isinstance(posterior, StackedPosterior)]:
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
    figure, panels = corner_panels(labels, limits, truth)
    for axes, pair in panels:
        if len(pair) == 1:
            draw_marginal(axes, draws[:, pair[0]], {"color": GREY})
            for name, end in ends.items():
                for value in end[:, pair[0]].tolist():
                    axes.axvline(value, **SETS[name], lw=1.8, markevery=[])
            continue
        for name in sorted(found, key=lambda name: -len(members[name])):
            colour, columns = SETS[name]["color"], members[name][:, pair].T.numpy()
            axes.scatter(*columns, s=5, color=colour, lw=0, rasterized=True)
    from matplotlib.lines import Line2D

    styles = {f"{100 * level:.4g} %, {name}": SETS[name] for name in found}
    styles |= {} if truth is None else {"truth": TRUTH}
    corner_legend(figure, [Line2D([], [], label=k, **v) for k, v in styles.items()])
    return figure


def overview(
    *,
    simulated: Tensor,
    before: Tensor,
    after: Tensor,
    weights: Tensor,
    samples: Mapping[str, Tensor],
    theta: Tensor,
    parameter_names: Sequence[str],
    prior: Tensor | None = None,
) -> "Figure":
    r"""Draw what RoPE does for one observation: tune, couple, mix.

    1. *Tune* shows the embeddings of real observations before and after tuning, in the
       plane of the first two principal components of the simulations' embeddings.
       Contours enclose 90 % of the observations. The arrow shows how far the first one
       moves.
    2. *Couple* shows the simulations in the same plane. The larger and darker a
       simulation is, the larger is its weight in the posterior of the first
       observation, which is the star.
    3. *Mix* shows the posterior of that observation, as in :func:`pair_plot`.

    Args:
        simulated: Embeddings of simulations :math:`h(x_s)`, shape ``(n_s, l)``:
            ``posterior.coupling.simulated``.
        before: Embeddings :math:`h(x_o)` before tuning, shape ``(n_o, l)``.
        after: Embeddings :math:`g(x_o)` after tuning, shape ``(n_o, l)``.
        weights: The weights of the simulations for the first observation, shape
            ``(n_s,)``: ``posterior.weights[0]``.
        samples: Samples of its posterior by method name, each of shape
            ``(num_samples, d)``. The first two parameters are shown.
        theta: Its true parameter, shape ``(d,)``.
        parameter_names: As in :func:`pair_plot`.
        prior: As in :func:`pair_plot`.

    Returns:
        The figure, with three panels.
    """
    width = np.shape(simulated)[-1:]
    simulated, before, after = _in_plane(
        as_drawn("simulated", simulated, width),
        as_drawn("before", before, width),
        as_drawn("after", after, width),
    )
    weights = as_drawn("weights", weights, (), rows=len(simulated))
    drawn = as_posteriors(samples, theta, parameter_names, prior)
    draws, truth, names, limits, ends = drawn
    figure = empty_figure(9.6, 3.9)
    tune, couple, mix = figure.subplots(1, 3)

    _draw_simulations(tune, simulated, before, after)
    tune.collections[0].set_label("simulations")
    tune.set_ylabel("2nd principal component" if width != (1,) else "")
    for points, colour, line, label in (
        (before, VERMILLION, "--", "real, before tuning"),
        (after, BLUE, "-", "real, after tuning"),
    ):
        draw_contours(tune, points, {"color": colour, "linestyle": line}, shares=[0.9])
        style = {"s": 9, "color": colour, "alpha": 0.7, "label": label}
        tune.scatter(*points[:MAX_REAL].T, **style, **DOTS)
    tune.plot(*after[0].tolist(), **STAR, zorder=6)
    tune.annotate("", after[0].tolist(), before[0].tolist(), arrowprops=ARROW, zorder=7)

    _draw_simulations(couple, simulated, after[:1])
    couple.plot(*after[0].tolist(), **STAR, ls="", zorder=6, label="a real observation")
    heaviest = weights.argsort(descending=True)[:MAX_SIMULATED]
    size = weights[heaviest] / weights.max()
    style = {"s": 90 * size, "alpha": 0.1 + 0.7 * size, "color": BLUE, "zorder": 3}
    couple.scatter(*simulated[heaviest].T, **style, **DOTS)
    count = float(weights.sum() ** 2 / weights.square().sum())
    label = f"its {count:.0f} or so simulations"
    couple.plot([], [], "o", color=BLUE, mew=0, label=label)

    shown = list(range(len(names)))[:2]
    set_up_panel(mix, names, limits, truth, shown)
    draw_posteriors(mix, draws, ends, shown)
    # The legends are below the panels, because points can be in any corner inside.
    style = {"frameon": False, "loc": "upper center"}
    tune.legend(**style, bbox_to_anchor=(0.5, -0.08), markerscale=2)
    couple.legend(**style, bbox_to_anchor=(0.5, -0.08))
    mix.legend(**style, bbox_to_anchor=(0.5, -0.16), ncols=2)
    tune.set_title("1.  Tune: real data move\n     onto simulations", **TITLE)
    couple.set_title("2.  Couple: weigh simulations\n     for each", **TITLE)
    mix.set_title("3.  Mix: average\n     their posteriors", **TITLE)
    return figure


def _in_plane(simulated: Tensor, *others: Tensor) -> list[Tensor]:
    """Project embeddings to the two directions in which simulations vary most."""
    # A few extreme embeddings must not turn the plane.
    core = simulated.clamp(*central_interval(simulated))
    centre = core.mean(dim=0)
    basis = torch.linalg.svd(core - centre, full_matrices=False).Vh[:2].T
    clouds = [(points - centre) @ basis for points in (simulated, *others)]
    if basis.shape[1] == 2:
        return clouds
    # In one dimension, dots are spread out along the other axis.
    heights = [torch.arange(len(points))[:, None] * 0.618 % 1 for points in clouds]
    return [torch.cat(pair, dim=1) for pair in zip(clouds, heights, strict=True)]


def _draw_simulations(axes: "Axes", simulated: Tensor, *others: Tensor) -> None:
    """Draw simulations in a panel that holds the central 99 % of all points."""
    hide_frame(axes)
    spans = torch.cat([central_interval(points) for points in (simulated, *others)])
    x, y = with_margin(spans.amin(dim=0), spans.amax(dim=0)).T.tolist()
    axes.set(xlim=x, ylim=y, xticks=[], yticks=[], xlabel="1st principal component")
    axes.scatter(*simulated[:MAX_SIMULATED].T, s=9, color="0.72", **DOTS)
