"""Empty figures, and the colours and line styles that all plots share."""

from collections.abc import Iterable
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
    figure = empty_figure(width, height)
    axes = figure.subplots()
    hide_frame(axes)
    return figure, axes


def empty_figure(width: float, height: float) -> "Figure":
    """Return a figure without a panel."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def hide_frame(axes: "Axes") -> None:
    """Hide the upper and the right edge of a panel."""
    axes.spines[["top", "right"]].set_visible(False)


def draw_calibrated_band(
    axes: "Axes", num_observations: int, *, label: str | None = None
) -> None:
    r"""Draw the diagonal and the band around it that holds calibrated posteriors.

    At each level :math:`\alpha` the band holds 95 % of the coverage curves of one
    parameter, :math:`\alpha \pm 1.96 \sqrt{\alpha (1 - \alpha) / n}`.
    """
    alpha = torch.linspace(0.0, 1.0, 201)
    width = 1.96 * (alpha * (1.0 - alpha) / num_observations).sqrt()
    low, high = (alpha - width).clamp(min=0.0), (alpha + width).clamp(max=1.0)
    axes.fill_between(alpha, low, high, color="0.85", label=label)
    axes.plot([0, 1], [0, 1], color=GREY, lw=0.8)
    axes.set(xlim=(0, 1), ylim=(0, 1), box_aspect=1)


def add_legend_above(figure: "Figure", axes: "Axes") -> None:
    """Add a legend of one row above the figure, with what is in one of its panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
    )


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return a line style for each method; different methods look different."""
    names = list(names)
    known = {name: METHOD_STYLES[name] for name in names if name in METHOD_STYLES}
    colours = _without(COLOURS, [colour for colour, _ in known.values()])
    lines = _without(LINE_STYLES, [line for _, line in known.values()])
    others = [name for name in names if name not in known]
    pairs = known | {
        name: (colours[i % len(colours)], lines[i % len(lines)])
        for i, name in enumerate(others)
    }
    return {
        name: {"color": pairs[name][0], "linestyle": pairs[name][1], "linewidth": 1.8}
        for name in names
    }


def _without(values: list[str], taken: list[str]) -> list[str]:
    return [value for value in values if value not in taken]
