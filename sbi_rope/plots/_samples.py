"""Draw posterior samples in a panel: limits of axes, histograms, contours."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.plots._figures import GREY, PRIOR, hide_frame
from sbi_rope.settings import names_of
from sbi_rope.tensors import as_batch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# How far beyond their core the axes may reach, in widths of the core.
REACH = 1.0
# The shares of the samples that contours enclose.
LEVELS = (0.9, 0.5)
# The number of grid points on each axis for contours.
GRID = 100
# The edge of the prior is drawn if this share of a posterior is beyond it.
CROSSED = 0.01


def as_samples(
    samples: Mapping[str, Tensor],
    theta: Tensor | None,
    parameter_names: Sequence[str] | None,
) -> tuple[dict[str, Tensor], Tensor | None, list[str]]:
    """Return samples by method, the truth, and a name for each parameter."""
    width = np.shape(next(iter(samples.values())))[-1:]
    draws = {
        name: as_drawn(f"samples[{name!r}]", value, width)
        for name, value in samples.items()
    }
    dim = width[0]
    names = [f"$\\theta_{j + 1}$" for j in range(dim)]
    if parameter_names is not None:
        names = list(names_of(parameter_names, dim))
    if theta is None:
        return draws, None, names
    return draws, as_drawn("theta", theta, (), rows=dim), names


def as_drawn(
    name: str, value: Any, event_shape: Sequence[int], rows: int | None = None
) -> Tensor:
    """Return a batch of a user on the CPU in float64, see ``tensors.as_batch``."""
    return as_batch(name, value, event_shape, rows=rows).cpu().double()


def central_interval(values: Tensor) -> Tensor:
    """Return the ends of the central 99 % of each column, shape ``(2, d)``.

    If there are five rows or more, at least the smallest and the largest are left out.
    """
    last = len(values) - 1
    # The ends are not interpolated, which would let a single extreme value have a say.
    low = min(math.ceil(0.005 * last), last // 4)
    return values.sort(dim=0).values[[low, last - low]]


def robust_limits(
    draws: Sequence[Tensor], truth: Tensor | None, prior: Tensor | None = None
) -> Tensor:
    """Return the limits of the axes, shape ``(2, d)``.

    The axes always hold a core. It consists of the truth and of the prior's interval if
    that is given. Otherwise it consists of the truth and the central 99 % of each
    posterior that has the truth inside. The axes hold the central 99 % of the other
    posteriors as far as it is within ``REACH`` times the width of the core.
    """
    spans = torch.stack([central_interval(value) for value in draws])
    low, high = spans[:, 0], spans[:, 1]  # one row a posterior
    core_low, core_high = low.amin(dim=0), high.amax(dim=0)
    if prior is not None:
        core_low, core_high = prior[0], prior[1]
    elif truth is not None:
        around = (low <= truth) & (truth <= high)
        inf = torch.full_like(low, torch.inf)
        # If no posterior has the truth inside, all of them belong to the core.
        some = around.any(dim=0)
        core_low = torch.where(
            some, torch.where(around, low, inf).amin(dim=0), core_low
        )
        core_high = torch.where(
            some, torch.where(around, high, -inf).amax(dim=0), core_high
        )
    if truth is not None:
        core_low, core_high = core_low.minimum(truth), core_high.maximum(truth)
    width = _width(core_low, core_high)
    floor, ceiling = core_low - REACH * width, core_high + REACH * width
    visible = (low <= ceiling) & (high >= floor)
    low = torch.where(visible, low.maximum(floor), core_low).amin(dim=0)
    high = torch.where(visible, high.minimum(ceiling), core_high).amax(dim=0)
    return with_margin(low.minimum(core_low), high.maximum(core_high))


def with_margin(low: Tensor, high: Tensor) -> Tensor:
    """Return limits that are a little wider than an interval, shape ``(2, d)``."""
    margin = 0.06 * _width(low, high)
    return torch.stack([low - margin, high + margin])


def _width(low: Tensor, high: Tensor) -> Tensor:
    """Return the width of an interval; that of a single point is set to be visible."""
    size = torch.maximum(low.abs(), high.abs())
    visible = torch.where(size > 0, size, torch.ones_like(size))
    return torch.where(high - low > 1e-9 * size, high - low, visible)


def corner_panels(
    figure: "Figure", names: Sequence[str], limits: Tensor, truth: Tensor | None
) -> Iterator[tuple["Axes", list[int]]]:
    """Add a panel for each parameter and each pair, and yield each before its truth.

    Args:
        figure: An empty figure.
        names: The labels of the parameters.
        limits: The limits of the axes, shape ``(2, d)``.
        truth: The true parameter, shape ``(d,)``.

    Yields:
        A panel, and the one or two parameters that it shows.
    """
    dim = len(names)
    for row in range(dim):
        for column in range(row + 1):
            axes = figure.add_subplot(dim, dim, row * dim + column + 1)
            hide_frame(axes)
            axes.set_xlim(*limits[:, column].tolist())
            if row == column:
                yield axes, [row]
                axes.spines["left"].set_visible(False)
                axes.set_yticks([])
                axes.set_ylim(bottom=0)
                if truth is not None:
                    axes.axvline(float(truth[row]), color="black", lw=1.2)
            else:
                axes.set_ylim(*limits[:, row].tolist())
                yield axes, [column, row]
                if truth is not None:
                    pair = truth[[column, row]].tolist()
                    axes.plot(*pair, "o", color="black", ms=4, zorder=5)
            axes.tick_params(labelbottom=row == dim - 1, labelleft=column == 0)
            if row == dim - 1:
                axes.set_xlabel(names[column])
            if column == 0 and row > 0:
                axes.set_ylabel(names[row])


def corner_legend(figure: "Figure", handles: list[Any], truth: Tensor | None) -> None:
    """Add a legend in the empty half of the figure, or above a single panel."""
    from matplotlib.lines import Line2D

    if truth is not None:
        style: dict[str, Any] = {"color": "black", "lw": 1.2, "marker": "o", "ms": 4}
        handles = [*handles, Line2D([], [], label="truth", **style)]
    place = "upper right" if len(figure.axes) > 1 else "outside upper center"
    figure.legend(handles=handles, loc=place, frameon=False)


def shade_prior(axes: "Axes", interval: Tensor) -> None:
    """Shade the prior's interval of one or two parameters, ``(2, 1)`` or ``(2, 2)``."""
    style: dict[str, Any] = {"color": PRIOR, "lw": 0, "zorder": 0}
    low, high = interval.tolist()
    if len(low) == 1:
        axes.axvspan(low[0], high[0], **style)
    else:
        axes.fill_between([low[0], high[0]], low[1], high[1], **style)


def edges_crossed(prior: Tensor, draws: Sequence[Tensor]) -> Tensor:
    """Return the ends of the prior's draws that samples are beyond, shape ``(2, d)``.

    An end is NaN unless one in a hundred samples of a posterior is beyond it.
    """
    low, high = prior.amin(dim=0), prior.amax(dim=0)
    below, above = (
        torch.stack([beyond(value).double().mean(dim=0) for value in draws]).amax(dim=0)
        for beyond in (lambda value: value < low, lambda value: value > high)
    )
    return torch.stack(
        [
            low.where(below >= CROSSED, torch.nan),
            high.where(above >= CROSSED, torch.nan),
        ]
    )


def draw_edges(axes: "Axes", edges: Tensor) -> None:
    """Draw ends of the prior in a panel of one or two parameters, unless NaN."""
    style: dict[str, Any] = {"color": GREY, "lw": 1.0, "ls": ":", "zorder": 1}
    for draw, ends in zip((axes.axvline, axes.axhline), edges.T.tolist(), strict=False):
        for end in ends:
            if not math.isnan(end):
                draw(end, **style)


def label_with_share(name: str, values: Tensor, limits: Tensor) -> str:
    """Return the name of a method, with the share of samples outside if it is large."""
    inside = ((values >= limits[0]) & (values <= limits[1])).all(dim=1)
    outside = 1.0 - float(inside.double().mean())
    # The axes are made to leave out one sample in a hundred of each parameter.
    if outside <= 0.05 + 0.01 * limits.shape[1]:
        return name
    return f"{name} ({100 * outside:.0f} % outside)"


def draw_marginal(axes: "Axes", values: Tensor, style: Mapping[str, Any]) -> None:
    """Draw a histogram of ``values``, shape ``(n,)``, with an area of one.

    The limits of the axes must be set before. Nothing is drawn for samples outside, so
    that they cannot change the height of the panel.
    """
    low, high = central_interval(values.unsqueeze(1)).flatten().tolist()
    left, right = axes.get_xlim()
    if low > right or high < left:
        return
    if _is_point(low, high):
        axes.axvline(low, **style)
        return
    # Only the central samples set the bins, but the area counts all of them.
    num_bins = min(max(round(len(values) ** 0.5), 5), 30)
    counts, edges = torch.histogram(values, bins=num_bins, range=(low, high))
    density = counts / (len(values) * (edges[1] - edges[0]))
    # The lines are solid, because dashed steps are hard to read.
    axes.stairs(density.numpy(), edges.numpy(), color=style["color"], lw=1.6)


def draw_contours(
    axes: "Axes",
    values: Tensor,
    style: Mapping[str, Any],
    *,
    fill: bool = False,
    bounded: bool = True,
    shares: Sequence[float] = LEVELS,
) -> None:
    """Draw contours that enclose shares of ``values``, shape ``(n, 2)``.

    The limits of the axes must be set before. If ``bounded``, nothing is drawn beyond
    the outermost values. Otherwise the smoothing could move the contours of a posterior
    out of the prior's support.

    Args:
        axes: The panel.
        values: The samples.
        style: The colour and line style.
        fill: Whether the areas inside the contours are filled.
        bounded: Whether the contours end at the outermost values.
        shares: The shares of the samples, the largest first.
    """
    low, high = central_interval(values)
    margin = (high - low) / 2
    core = values[((values >= low - margin) & (values <= high + margin)).all(dim=1)]
    colour = style["color"]
    # Along the principal axes, the smoothing does not widen a narrow ridge.
    centre = core.mean(dim=0) if len(core) else values.mean(dim=0)
    scale, directions = torch.linalg.eigh((core - centre).T.cov(correction=0))
    scale = scale.clamp(min=0.0).sqrt()
    flat = [_is_point(float(a), float(b)) for a, b in zip(low, high, strict=True)]
    if all(flat):
        axes.plot(*centre.tolist(), "o", color=colour, ms=5)
        return
    if any(flat) or scale[0] < 1e-6 * scale[1]:
        ends = core[(core - centre).matmul(directions[:, 1]).argsort()[[0, -1]]]
        axes.plot(ends[:, 0].numpy(), ends[:, 1].numpy(), **style)
        return
    density, grid = _smoothed((core - centre) @ directions / scale)
    points = (grid * scale) @ directions.T + centre
    x, y = points[..., 0].numpy(), points[..., 1].numpy()
    levels = _levels(density, shares)
    drawn = [axes.contour(x, y, density.numpy(), levels, colors=[colour])]
    drawn[0].set_linestyle(style["linestyle"])
    if fill:
        top = 1.01 * float(density.max())
        drawn += [
            axes.contourf(x, y, density.numpy(), [a, top], colors=[colour], alpha=0.16)
            for a in levels
        ]
    for contours in drawn:
        contours.set_in_layout(False)
    if bounded:
        _cut_at_outermost(axes, drawn, values)


def _cut_at_outermost(axes: "Axes", drawn: Sequence[Any], values: Tensor) -> None:
    """Cut contours off at the outermost values that are inside the axes."""
    from matplotlib.patches import Rectangle

    left, right = _overlap(values[:, 0], axes.get_xlim())
    bottom, top = _overlap(values[:, 1], axes.get_ylim())
    frame = Rectangle(
        (left, bottom), right - left, top - bottom, transform=axes.transData
    )
    for contours in drawn:
        contours.set_clip_path(frame)


def _overlap(values: Tensor, limits: tuple[float, float]) -> tuple[float, float]:
    low, high = max(float(values.min()), limits[0]), min(float(values.max()), limits[1])
    return low, max(low, high)


def _is_point(low: float, high: float) -> bool:
    return high - low <= 1e-9 * max(abs(low), abs(high), 1e-300)


def _smoothed(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the density of whitened values on a grid, and the points of the grid."""
    bandwidth = len(values) ** (-1 / 6)  # Scott's rule
    low = values.amin(dim=0) - 3 * bandwidth
    high = values.amax(dim=0) + 3 * bandwidth
    ticks = [
        torch.linspace(float(a), float(b), GRID, dtype=values.dtype)
        for a, b in zip(low, high, strict=True)
    ]
    kernels = [
        torch.exp(-((tick.unsqueeze(1) - column) ** 2) / (2 * bandwidth**2))
        for tick, column in zip(ticks, values.T, strict=True)
    ]
    return kernels[0] @ kernels[1].T, torch.cartesian_prod(*ticks).reshape(
        GRID, GRID, 2
    )


def _levels(density: Tensor, shares: Sequence[float]) -> list[float]:
    """Return the densities whose contours enclose the shares, in increasing order."""
    ordered = density.flatten().sort(descending=True).values
    mass = ordered.cumsum(0) / ordered.sum()
    return [float(ordered[(mass < share).sum()]) for share in shares]
