"""Several posteriors of one observation in one picture."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from sbi_rope.plots._figures import PRIOR, empty_figure, hide_frame, line_styles
from sbi_rope.plots._samples import (
    as_drawn,
    as_samples,
    central_interval,
    draw_contours,
    draw_edges,
    draw_marginal,
    edges_crossed,
    label_with_share,
    robust_limits,
    shade_prior,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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

    Raises:
        InvalidInputError: If the shapes differ, or a sample is not finite.
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
    for row in range(dim):
        for column in range(row + 1):
            axes = figure.add_subplot(dim, dim, row * dim + column + 1)
            pair = [column] if row == column else [column, row]
            _draw_panel(
                axes,
                {name: value[:, pair] for name, value in draws.items()},
                None if truth is None else truth[pair],
                limits[:, pair],
                None if interval is None else interval[:, pair],
            )
            if edges is not None:
                draw_edges(axes, edges[:, pair])
            axes.tick_params(labelbottom=row == dim - 1, labelleft=column == 0)
            if row == dim - 1:
                axes.set_xlabel(names[column])
            if column == 0 and row > 0:
                axes.set_ylabel(names[row])
    _add_legend(figure, draws, truth, limits, shaded=interval is not None)
    return figure


def _draw_panel(
    axes: "Axes",
    draws: Mapping[str, Tensor],
    truth: Tensor | None,
    limits: Tensor,
    interval: Tensor | None,
) -> None:
    """Draw one parameter, or a pair of parameters."""
    hide_frame(axes)
    is_marginal = limits.shape[1] == 1
    axes.set_xlim(*limits[:, 0].tolist())
    if not is_marginal:
        axes.set_ylim(*limits[:, 1].tolist())
    if interval is not None:
        shade_prior(axes, interval)
    for name, style in line_styles(draws).items():
        if is_marginal:
            draw_marginal(axes, draws[name][:, 0], style)
        else:
            draw_contours(axes, draws[name], style)
    if is_marginal:
        axes.spines["left"].set_visible(False)
        axes.set_yticks([])
        axes.set_ylim(bottom=0)
    if truth is not None and is_marginal:
        axes.axvline(float(truth[0]), color="black", lw=1.2)
    elif truth is not None:
        axes.plot(*truth.tolist(), "o", color="black", ms=4, zorder=5)


def _add_legend(
    figure: "Figure",
    draws: Mapping[str, Tensor],
    truth: Tensor | None,
    limits: Tensor,
    *,
    shaded: bool,
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    styles = line_styles(draws)
    handles: list[Any] = [
        Line2D([], [], label=label_with_share(name, value, limits), **styles[name])
        for name, value in draws.items()
    ]
    if truth is not None:
        handles.append(
            Line2D([], [], color="black", lw=1.2, marker="o", ms=4, label="truth")
        )
    if shaded:
        handles.append(Patch(color=PRIOR, label="prior"))
    # The legend is in the empty half of the figure, or above a single panel.
    if limits.shape[1] > 1:
        figure.legend(handles=handles, loc="upper right", frameon=False)
    else:
        figure.legend(handles=handles, loc="outside upper center", frameon=False)
