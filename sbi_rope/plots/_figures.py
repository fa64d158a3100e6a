"""Empty figures, and the colours and line styles that all plots share."""

from collections.abc import Iterable
from itertools import cycle
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The palette of Okabe and Ito, without yellow, which is too light for lines on white.
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY = "#CC79A7", "#E69F00", "#56B4E9"
COLOURS = [BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY]
LINE_STYLES = ["-", "--", "-.", ":"]
GREY, PRIOR = "0.45", "0.93"
# These two methods look the same in every picture.
METHOD_STYLES = {"RoPE": (BLUE, "-"), "NPE": (VERMILLION, "--")}


def new_figure(width: float, height: float) -> "tuple[Figure, Axes]":
    """Return a figure with one panel. It has no window and need not be closed."""
    figure, (axes,) = panel_grid(1, columns=1, width=width, height=height)
    return figure, axes


def empty_figure(width: float, height: float) -> "Figure":
    """Return a figure without a panel."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def panel_grid(
    count: int, *, columns: int, width: float, height: float
) -> "tuple[Figure, list[Axes]]":
    """Return a figure with panels of a size, in at most as many columns."""
    rows, columns = -(-count // columns), min(count, columns)
    figure = empty_figure(width * columns, height * rows)
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(count)]
    for axes in panels:
        hide_frame(axes)
    return figure, panels


def hide_frame(axes: "Axes") -> None:
    """Hide the upper and the right edge of a panel."""
    axes.spines[["top", "right"]].set_visible(False)


def draw_calibrated_band(
    axes: "Axes", num_observations: float, *, label: str | None = None
) -> None:
    """Draw the diagonal, and the band of ``calibration_curves`` around it."""
    alpha = torch.linspace(0.0, 1.0, 201)
    width = 1.96 * (alpha * (1.0 - alpha) / num_observations).sqrt()
    axes.fill_between(alpha, alpha - width, alpha + width, color="0.85", label=label)
    axes.plot([0, 1], [0, 1], color=GREY, lw=0.8)
    axes.set(xlim=(0, 1), ylim=(0, 1))


def add_legend_above(figure: "Figure", axes: "Axes") -> None:
    """Add a legend of one row above the figure, with what is in one of its panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
    )


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return a line style for each method; different methods look different."""
    names = list(names)
    taken = {part for name in names for part in METHOD_STYLES.get(name, ())}
    colours = cycle([colour for colour in COLOURS if colour not in taken])
    lines = cycle([line for line in LINE_STYLES if line not in taken])
    styles = {}
    for name in names:
        colour, line = METHOD_STYLES.get(name) or (next(colours), next(lines))
        styles[name] = {"color": colour, "linestyle": line, "linewidth": 1.8}
    return styles
