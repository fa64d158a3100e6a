"""Several posteriors of one observation in one picture."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from sbi_rope.plots._figures import PRIOR, empty_figure, line_styles
from sbi_rope.plots._samples import (
    as_drawn,
    as_samples,
    central_interval,
    corner_legend,
    corner_panels,
    draw_contours,
    draw_edges,
    draw_marginal,
    edges_crossed,
    label_with_share,
    robust_limits,
    shade_prior,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["pair_plot"]


def pair_plot(
    samples: Mapping[str, Tensor],
    theta: Tensor | None = None,
    *,
    parameter_names: Sequence[str] | None = None,
    prior: Tensor | None = None,
) -> "Figure":
    """Draw the marginals and pairs of several posteriors of one observation.

    Contours enclose 50 % and 90 % of the samples. The axes hold the true parameter and
    the central 99 % of every posterior, so that a few extreme samples do not squeeze
    the picture. A posterior that is far from the prior may lie outside the axes, and so
    may one that is far from the truth while another posterior has the truth inside. The
    legend then says which share of its samples is outside.

    Args:
        samples: Posterior samples by method name, each of shape ``(num_samples, d)``.
        theta: The true parameter, shape ``(d,)``, which is marked in black.
        parameter_names: A label for each parameter, with its unit.
        prior: Samples of the prior, shape ``(n, d)``. Their central 99 % is shaded.
            Where posterior samples are beyond all of them, a dotted line marks the end.

    Returns:
        The figure, with d rows and columns and the marginals on the diagonal.
    """
    draws, truth, names = as_samples(samples, theta, parameter_names)
    dim = len(names)
    figure = empty_figure(2.0 * dim + 0.8, 2.0 * dim + 1.0)
    interval = edges = None
    if prior is not None:
        prior = as_drawn("prior", prior, (dim,))
        interval = central_interval(prior)
        edges = edges_crossed(prior, list(draws.values()))
    limits = robust_limits(list(draws.values()), truth, interval)
    styles = line_styles(draws)
    for axes, pair in corner_panels(figure, names, limits, truth):
        if interval is not None:
            shade_prior(axes, interval[:, pair])
        for name, style in styles.items():
            if len(pair) == 1:
                draw_marginal(axes, draws[name][:, pair[0]], style)
            else:
                draw_contours(axes, draws[name][:, pair], style)
        if edges is not None:
            draw_edges(axes, edges[:, pair])
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Line2D([], [], label=label_with_share(name, value, limits), **styles[name])
        for name, value in draws.items()
    ]
    if interval is not None:
        handles.append(Patch(color=PRIOR, label="prior"))
    corner_legend(figure, handles, truth)
    return figure
