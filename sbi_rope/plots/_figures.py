"""Empty figures, and the colours and line styles that all plots share."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

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
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ImportError(
            "matplotlib is not installed. Run `pip install sbi-rope[benchmarks]`."
        ) from error

    return Figure(figsize=(width, height), layout="constrained")


def hide_frame(axes: "Axes") -> None:
    """Hide the upper and the right edge of a panel."""
    axes.spines[["top", "right"]].set_visible(False)


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
