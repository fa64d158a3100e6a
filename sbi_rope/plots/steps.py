"""The three steps of RoPE in one picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.plots._figures import (
    BLUE,
    PRIOR,
    VERMILLION,
    empty_figure,
    hide_frame,
    line_styles,
)
from sbi_rope.plots._samples import (
    as_drawn,
    as_samples,
    central_interval,
    draw_contours,
    draw_marginal,
    label_with_share,
    robust_limits,
    shade_prior,
    with_margin,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["overview"]

SIMULATED = "0.72"
STAR: dict[str, Any] = {
    "marker": "*",
    "ms": 17,
    "mec": "white",
    "mew": 1.0,
    "color": "black",
    "ls": "none",
    "zorder": 6,
}
# The most dots that are drawn. More would run together.
MAX_SIMULATED, MAX_REAL = 1000, 250
# The layout is fixed, so that all panels have one size.
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 11}
LAYOUT = {"left": 0.04, "right": 0.99, "bottom": 0.28, "top": 0.88, "wspace": 0.2}


@dataclass(frozen=True)
class _Plane:
    """Embeddings in the plane of the simulations' first two principal components.

    ``flat`` says that embeddings have a single dimension. The second coordinate then
    only spreads them out.
    """

    simulated: Tensor
    before: Tensor
    after: Tensor
    flat: bool


def overview(
    *,
    simulated: Tensor,
    before: Tensor,
    after: Tensor,
    weights: Tensor,
    samples: Mapping[str, Tensor],
    theta: Tensor,
    parameter_names: Sequence[str],
    parameters: Sequence[int] | None = None,
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
    3. *Mix* shows the posterior of that observation. Contours enclose 50 % and 90 % of
       the samples.

    The axes hold the central 99 % of the embeddings. Those of the last panel are found
    as in :func:`pair_plot`.

    Args:
        simulated: Embeddings of simulations :math:`h(x_s)`, shape ``(n_s, l)``, such as
            ``posterior.coupling.simulated``.
        before: Embeddings :math:`h(x_o)` before tuning, shape ``(n_o, l)``.
        after: Embeddings :math:`g(x_o)` after tuning, shape ``(n_o, l)``.
        weights: The weights of the simulations for the first observation, shape
            ``(n_s,)``, such as ``posterior.weights[0]``.
        samples: Samples of its posterior by method name, each of shape
            ``(num_samples, d)``.
        theta: Its true parameter, shape ``(d,)``.
        parameter_names: A label for each parameter, with its unit.
        parameters: The one or two parameters to show. None shows the first two.
        prior: Samples of the prior, shape ``(n, d)``. Their central 99 % is shown in
            grey.

    Returns:
        The figure, with three panels.
    """
    width = np.shape(simulated)[-1:]
    plane = _plane(
        as_drawn("simulated", simulated, width),
        as_drawn("before", before, width),
        as_drawn("after", after, width),
    )
    weights = as_drawn("weights", weights, (), rows=len(plane.simulated))
    draws, truth, names = as_samples(samples, theta, parameter_names)
    assert truth is not None
    chosen = list(range(len(names))[:2] if parameters is None else parameters)
    interval = None
    if prior is not None:
        interval = central_interval(as_drawn("prior", prior, truth.shape))[:, chosen]

    figure = empty_figure(9.6, 3.9)
    figure.set_layout_engine("none")
    tune, couple, mix = figure.subplots(1, 3, gridspec_kw=LAYOUT)
    for axes in (tune, couple, mix):
        hide_frame(axes)
    _draw_tuning(tune, plane)
    _draw_coupling(couple, plane, weights)
    _draw_posteriors(
        mix,
        {name: value[:, chosen] for name, value in draws.items()},
        truth[chosen],
        [names[j] for j in chosen],
        interval,
    )
    return figure


def _draw_tuning(axes: "Axes", plane: _Plane) -> None:
    clouds = [plane.simulated, plane.before, plane.after]
    _set_up_plane(axes, plane, clouds, plane.after[0])
    _scatter(axes, plane.simulated, s=9, color=SIMULATED)
    for points, colour, line in (
        (plane.before, VERMILLION, "--"),
        (plane.after, BLUE, "-"),
    ):
        _scatter(axes, points, MAX_REAL, s=9, color=colour, alpha=0.7, zorder=2)
        if not plane.flat:
            style = {"color": colour, "linestyle": line, "linewidth": 1.8}
            draw_contours(axes, points, style, bounded=False, shares=[0.9])
    start, end = plane.before[0], plane.after[0]
    axes.plot(*end.tolist(), **STAR)
    axes.annotate(
        "",
        xy=(float(end[0]), float(end[1])),
        xytext=(float(start[0]), float(start[1])),
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.6},
        zorder=7,
    )
    handles = [
        _dot(SIMULATED, "simulations"),
        _dot(VERMILLION, "real, before tuning"),
        _dot(BLUE, "real, after tuning"),
    ]
    _legend(axes, handles)
    axes.set_title("1.  Tune: real data move\n     onto simulations", **TITLE)


def _draw_coupling(axes: "Axes", plane: _Plane, weights: Tensor) -> None:
    star = plane.after[0]
    _set_up_plane(axes, plane, [plane.simulated], star)
    relative = weights / weights.max()
    _scatter(axes, plane.simulated, s=9, color=SIMULATED)
    heaviest = relative.argsort()[-MAX_SIMULATED:]
    heaviest = heaviest[relative[heaviest] > 0.01]  # lighter ones cannot be seen
    size = relative[heaviest]
    _scatter(
        axes,
        plane.simulated[heaviest],
        s=(4 + 90 * size).numpy(),
        color=BLUE,
        alpha=(0.1 + 0.7 * size).numpy(),
        zorder=3,
    )
    axes.plot(*star.tolist(), **STAR)
    count = 1.0 / float((weights / weights.sum()).square().sum())
    from matplotlib.lines import Line2D

    small: dict[str, Any] = STAR | {"ms": 12}
    handles = [
        Line2D([], [], **small, label="one real observation"),
        _dot(BLUE, f"its {count:.0f} or so simulations"),
    ]
    _legend(axes, handles)
    axes.set_title("2.  Couple: weigh simulations\n     for each", **TITLE)


def _draw_posteriors(
    axes: "Axes",
    draws: Mapping[str, Tensor],
    truth: Tensor,
    names: Sequence[str],
    interval: Tensor | None,
) -> None:
    limits = robust_limits(list(draws.values()), truth, interval)
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    axes.set_xlim(*limits[:, 0].tolist())
    if len(names) > 1:
        axes.set_ylim(*limits[:, 1].tolist())
    if interval is not None:
        shade_prior(axes, interval)
        handles.append(Patch(color=PRIOR, label="prior"))
    for name, style in line_styles(draws).items():
        label = label_with_share(name, draws[name], limits)
        handles.append(Line2D([], [], label=label, **style))
        if len(names) == 1:
            draw_marginal(axes, draws[name][:, 0], style)
        else:
            draw_contours(axes, draws[name], style, fill=True)
    axes.set_xlabel(names[0])
    if len(names) == 1:
        axes.axvline(float(truth[0]), color="black", lw=1.4)
        mark = Line2D([], [], color="black", lw=1.4)
        axes.set_ylim(bottom=0)
        axes.set_yticks([])
        axes.set_ylabel("density")
    else:
        cross: dict[str, Any] = STAR | {"marker": "X", "ms": 10}
        axes.plot(*truth.tolist(), **cross)
        mark = Line2D([], [], **cross)
        axes.set_ylabel(names[1])
    mark.set_label("truth")
    _legend(axes, [*handles, mark])
    axes.set_title("3.  Mix: average\n     their posteriors", **TITLE)


def _scatter(
    axes: "Axes", points: Tensor, most: int = MAX_SIMULATED, **style: Any
) -> None:
    """Draw every m-th point, with m such that there are not too many."""
    x, y = points[:: -(-len(points) // most)].T.numpy()
    axes.scatter(x, y, linewidths=0, rasterized=True, **style)


def _set_up_plane(
    axes: "Axes", plane: _Plane, clouds: Sequence[Tensor], star: Tensor
) -> None:
    spans = [central_interval(points) for points in clouds]
    points = torch.cat([*spans, star.unsqueeze(0)])
    limits = with_margin(points.amin(dim=0), points.amax(dim=0))
    axes.set_xlim(*limits[:, 0].tolist())
    axes.set_ylim(*limits[:, 1].tolist())
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel("embedding" if plane.flat else "1st principal component")
    axes.set_ylabel("(spread out)" if plane.flat else "2nd principal component")


def _dot(colour: str, label: str) -> "Line2D":
    from matplotlib.lines import Line2D

    return Line2D([], [], marker="o", ls="none", mew=0, color=colour, label=label)


def _legend(axes: "Axes", handles: Sequence[Any]) -> None:
    # The legend is below the panel, because points can be in any corner inside.
    axes.legend(
        handles=handles,
        frameon=False,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.14),
        fontsize=10,
        ncols=2,
        handletextpad=0.2,
        handlelength=1.2,
        columnspacing=0.5,
    )


def _plane(simulated: Tensor, before: Tensor, after: Tensor) -> _Plane:
    """Project embeddings to the two directions in which simulations vary most."""
    flat = simulated.shape[1] == 1
    if flat:
        clouds = [_spread_out(points) for points in (simulated, before, after)]
        return _Plane(*clouds, flat=True)
    centre = simulated.median(dim=0).values
    low, high = central_interval(simulated)
    # A few extreme embeddings must not turn the plane.
    core = torch.minimum(torch.maximum(simulated, low), high) - centre
    basis = torch.linalg.eigh(core.T.cov(correction=0)).eigenvectors[:, [-1, -2]]
    clouds = [(points - centre) @ basis for points in (simulated, before, after)]
    return _Plane(*clouds, flat=False)


def _spread_out(points: Tensor) -> Tensor:
    """Give one-dimensional embeddings a second coordinate that depends on the row."""
    golden = torch.arange(len(points), dtype=points.dtype) * 0.6180339887498949
    return torch.cat([points, golden.frac().unsqueeze(1)], dim=1)
