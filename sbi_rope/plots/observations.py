"""Pictures of real observations and simulations."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError
from sbi_rope.plots._figures import (
    BLUE,
    VERMILLION,
    add_legend_above,
    empty_figure,
    hide_frame,
)
from sbi_rope.plots._samples import as_drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["real_and_simulated"]

NUM_SHOWN = 6
NUM_COLUMNS = 4
# The share of the values that a histogram leaves out at either end.
TAIL = 0.005


def real_and_simulated(
    x_o: Tensor,
    x_s: Tensor,
    *,
    x_names: Sequence[str] | None = None,
    labels: tuple[str, str] = ("real", "simulated"),
) -> "Figure":
    """Draw real observations beside simulations with the same parameters.

    Of statistics, a histogram over all rows is drawn for each. Of series and images,
    the first six pairs are drawn.

    Args:
        x_o: Real observations. They are statistics, shape ``(n, l)``, series, shape
            ``(n, length)``, or images, shape ``(n, 3, height, width)``, with values in
            [0, 1].
        x_s: Simulations with the parameters of the real observations, same shape.
        x_names: A name for each of the l statistics. Without names, x with two
            dimensions are taken for series.
        labels: The names of real observations and simulations in the legend.

    Returns:
        The figure.
    """
    x_o = as_drawn("x_o", x_o, np.shape(x_o)[1:])
    x_s = as_drawn("x_s", x_s, x_o.shape[1:], rows=len(x_o))
    if x_names:
        return _histograms(x_o, x_s, x_names, labels)
    if x_o.ndim == 2:
        return _series(x_o, x_s, labels)
    if x_o.ndim == 4 and x_o.shape[1] == 3:
        return _images(x_o, x_s, labels)
    raise InvalidInputError(
        "Expected `x_o` of shape (n, l), (n, length) or (n, 3, height, width); got "
        f"{tuple(x_o.shape)}."
    )


def _histograms(
    x_o: Tensor, x_s: Tensor, names: Sequence[str], labels: tuple[str, str]
) -> "Figure":
    columns = min(len(names), NUM_COLUMNS)
    figure, panels = _panels(len(names), columns, width=2.6, height=2.2)
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        values = torch.cat([x_o[:, k], x_s[:, k]])
        tail = TAIL if len(values) * TAIL > 1 else 0.0
        low, high = (torch.quantile(values, q).item() for q in (tail, 1 - tail))
        if low == high:
            low, high = low - 0.5, high + 0.5
        for x, colour, label in (
            (x_s, VERMILLION, labels[1]),
            (x_o, BLUE, labels[0]),
        ):
            axes.hist(
                x[:, k].numpy(),
                bins=40,
                range=(low, high),
                density=True,
                histtype="stepfilled",
                alpha=0.45,
                color=colour,
                label=label,
            )
        axes.set_xlabel(name)
        axes.set_yticks([])
    add_legend_above(figure, panels[0])
    return figure


def _series(x_o: Tensor, x_s: Tensor, labels: tuple[str, str]) -> "Figure":
    count = min(len(x_o), NUM_SHOWN)
    figure, panels = _panels(count, min(count, 3), width=3.2, height=2.0)
    for i, axes in enumerate(panels):
        axes.plot(x_s[i].numpy(), color=VERMILLION, linewidth=1.2, label=labels[1])
        axes.plot(x_o[i].numpy(), color=BLUE, linewidth=1.2, label=labels[0])
    for axes in panels[-min(count, 3) :]:
        axes.set_xlabel("step")
    add_legend_above(figure, panels[0])
    return figure


def _images(x_o: Tensor, x_s: Tensor, labels: tuple[str, str]) -> "Figure":
    count = min(len(x_o), NUM_SHOWN)
    figure = empty_figure(1.5 * count + 0.3, 3.2)
    grid = figure.subplots(2, count, squeeze=False)
    for row, (label, x) in enumerate(zip(labels, (x_o, x_s), strict=True)):
        for axes, image in zip(grid[row], x, strict=False):
            axes.imshow(image.clamp(0, 1).permute(1, 2, 0).numpy())
            axes.set_xticks([])
            axes.set_yticks([])
        grid[row][0].set_ylabel(label)
    return figure


def _panels(
    count: int, columns: int, *, width: float, height: float
) -> "tuple[Figure, list[Axes]]":
    rows = -(-count // columns)
    figure = empty_figure(width * columns, height * rows + 0.3)
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
    for axes in grid[:count]:
        hide_frame(axes)
    return figure, grid[:count]
