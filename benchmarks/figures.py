"""The figures of a suite, and those of all tasks together."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from benchmarks.cells import Cell, data_in_words
from benchmarks.methods import METHODS, STACK
from benchmarks.published import LETTERS, Published, finished, known
from benchmarks.suites import Suite
from sbi_rope.plots._figures import empty_figure, hide_frame
from sbi_rope.utils.files import write_atomically

# Cells with the same of these have the same data, but for the repetition.
WHERE = ["task", "variant", "options"]
# With the distances as they are, as in the paper.
UNSCALED = {"RoPE": "#003050", "OT-only": "#2A6F97"}
# Lines that differ in calibration pairs only.
MARKERS = {10: "o", 50: "s", 200: "^"}
# More labels than these run into each other.
MAX_TICKS = 5
# More panels than this go to another row.
MAX_COLUMNS = 9
# Lines of a legend in an inch of height.
LEGEND_LINES = 4.5
# The methods of the picture of all tasks: what a user starts from, what learns from
# pairs, the rivals of 2025 and 2026, the paper's method and our default.
SHOWN = (
    "prior",
    "SBI",
    "NPE",
    "RVNP",
    "Regression",
    "fine-tuned NPE (averaged)",
    "FMCPE",
    "FRISBI (distilled)",
    "RoPE",
    STACK,
)
# Panels side by side, so that they can be read at the width of a page.
SHOWN_COLUMNS = 5


class LPPAxis:
    """The paper's axis: linear from the prior up, logarithmic below it.

    Args:
        prior: LPP of the prior.
        top: Highest LPP shown; the unit of the scale is its distance to the prior.
    """

    def __init__(self, prior: float, top: float) -> None:
        self.prior = prior
        self.unit = max(top - prior, 1e-3)

    def forward(self, value: Any) -> Any:
        """Map LPPs to heights."""
        z = (np.asarray(value, dtype=float) - self.prior) / self.unit
        return np.where(z >= 0, z, -np.log10(1 + 9 * np.maximum(-z, 0)))

    def inverse(self, height: Any) -> Any:
        """Map heights to LPPs."""
        height = np.asarray(height, dtype=float)
        below = -(10.0 ** np.maximum(-height, 0) - 1) / 9
        return self.prior + self.unit * np.where(height >= 0, height, below)


def draw_suite(suite: Suite, rows: pd.DataFrame, folder: Path) -> None:
    """Draw the scores of a suite into a folder, if it has any."""
    rows = finished(known(rows))
    if len(rows):
        _save(curves(suite.x_axis, rows), folder / f"{suite.x_axis}.png")


def draw_overview(published: Published, path: Path) -> None:
    """Draw scores on all tasks into a file."""
    rows = finished(published.main)
    order = {task: place for place, task in enumerate(LETTERS)}
    shown = rows[rows["method"].isin(SHOWN)].sort_values(
        "task", kind="stable", key=lambda tasks: tasks.map(order)
    )
    figure = curves("n_calibration", shown, max_columns=SHOWN_COLUMNS)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    """Write a figure without metadata, so that the same table gives the same bytes."""
    with write_atomically(path) as temporary:
        figure.savefig(temporary, format="png", dpi=90, metadata={"Software": None})


def curves(axis: str, rows: pd.DataFrame, *, max_columns: int = MAX_COLUMNS) -> Figure:
    """Draw LPP and ACAUC against a column, a panel for each task and variant."""
    panels = ["task"] if _is_option(axis) else WHERE
    groups = rows.groupby(panels, sort=False)
    bands = math.ceil(len(groups) / max_columns)
    columns = math.ceil(len(groups) / bands)
    figure = empty_figure(3.1 * columns + 1.9, 5.4 * bands)
    axes = figure.subplots(2 * bands, columns, squeeze=False)
    # Side by side, as if nothing was wrapped.
    axes = np.concatenate(np.split(axes, bands), axis=1)
    for part in axes[:, len(groups) :].flat:
        part.set_axis_off()
    seen: dict[str, Any] = {}
    for column, (where, group) in enumerate(groups):
        title = data_in_words(*where)
        title += ["(stand-in)"] if group["stand_in"].any() else []
        axes[0, column].set_title("\n".join(title), size="medium")
        _panel(axes[0, column], axis, group, "lpp_z", seen)
        _panel(axes[1, column], axis, group, "acauc", seen)
        axes[1, column].axhline(0, color="0.6", lw=0.8)
        axes[1, column].set_xlabel(axis.replace("_", " "))
        axes[0, column].tick_params(labelbottom=False)
        for part in axes[:, column]:
            hide_frame(part)
    axes[0, 0].set_ylabel("LPP, in prior sd")
    axes[1, 0].set_ylabel("ACAUC (0 is calibrated)")
    _add_legend(figure, seen)
    return figure


def _add_legend(figure: Figure, seen: dict[str, Any]) -> None:
    """Name all lines beside the panels, in as many columns as the height asks for."""
    lines = LEGEND_LINES * figure.get_figheight()
    figure.legend(
        seen.values(),
        seen.keys(),
        loc="outside right center",
        frameon=False,
        ncols=math.ceil(len(seen) / lines),
    )


def _panel(
    axes: Any, axis: str, rows: pd.DataFrame, score: str, seen: dict[str, Any]
) -> None:
    rows = rows.assign(position=[_position(axis, cell) for cell in rows.index])
    positions = sorted(rows["position"].dropna().unique())
    values = rows[score][np.isfinite(rows[score])]
    if not len(values):
        return
    if score == "lpp_z":
        _set_scale(axes, rows, values)
    bottom = axes.get_ylim()[0]
    # A list of a single label would be taken for a list of keys, which are tuples.
    labels = pd.Series(_lines(axis, rows), index=rows.index)
    for label, line in rows.groupby(labels, sort=False):
        cell = line.index[0]
        colour, style, marker = _style(cell)
        if axis != "n_calibration" and cell.n_calibration:
            marker = MARKERS.get(cell.n_calibration, marker)
        points = line.groupby("position")[score].agg(["mean", "std"]).fillna(0.0)
        mean = line[score].mean()
        if len(points):
            x, y = points.index, points["mean"]
            # One -inf makes a mean -inf, and is shown at the lower edge.
            lost = np.isinf(y)
            handle = axes.errorbar(
                x, y, points["std"], color=colour, ls=style, marker=marker, ms=4, lw=1.6
            )
            axes.plot(x[lost], np.full(lost.sum(), bottom), "v", color=colour)
        elif np.isfinite(mean):
            handle = axes.axhline(mean, color=colour, ls=style, lw=1.3)
        else:
            edge = [bottom] * len(positions)
            (handle,) = axes.plot(positions, edge, "v", color=colour)
        seen.setdefault(label, handle)
    if positions and positions[0] > 0 and positions[-1] / positions[0] >= 8:
        axes.set_xscale("log")
    turned = 90 if len(positions) > MAX_TICKS else 0
    axes.set_xticks(positions, [f"{p:g}" for p in positions], rotation=turned)
    axes.minorticks_off()


def _set_scale(axes: Any, rows: pd.DataFrame, values: pd.Series) -> None:
    """Give an axis of LPPs the paper's scale, from the prior and the line "SBI"."""

    def mean_of(method: str, default: float) -> float:
        known = values[rows["method"][values.index] == method]
        return known.mean() if len(known) else default

    low, high = values.min(), values.max()
    prior = mean_of("prior", low)
    scale = LPPAxis(prior, max(mean_of("SBI", prior), high))
    axes.set_yscale("function", functions=(scale.forward, scale.inverse))
    bottom = scale.inverse(scale.forward(low) - 0.1)
    axes.set_ylim(bottom, scale.inverse(scale.forward(high) + 0.1))
    _set_ticks(axes, scale, low, high)


def _set_ticks(axes: Any, scale: LPPAxis, low: float, high: float) -> None:
    """Put a tick at the prior, at round numbers above it, and at distances below it."""
    prior, unit = scale.prior, scale.unit
    above = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(prior, high)
    below = prior - float(f"{2 * unit:.1g}") * 3.0 ** np.arange(12)
    ticks = [prior, *above[(above > prior + unit / 6) & (above < high)]]
    ticks += [tick for tick in below if tick > low]
    axes.set_yticks(ticks, [f"{tick:.3g}" for tick in ticks])


def _lines(axis: str, rows: pd.DataFrame) -> list[str]:
    """Name the line of each row: all that is not on the axis tells lines apart."""
    rope = rows[rows["method"] == "RoPE"]
    several = [
        name
        for name in ("gamma", "tau", "n_calibration")
        if name != axis and rope[name].nunique() > 1
    ]
    labels = []
    for cell in rows.index:
        label = cell.method
        for name in several:
            if value := getattr(cell, name):
                label += f", {name.replace('n_calibration', 'n_c')} {value:g}"
        if cell.cost_scale == "none" and rope["cost_scale"].nunique() > 1:
            label += ", unscaled"
        labels.append(label)
    return labels


def _style(cell: Cell) -> tuple[str, str, str | None]:
    colour, line, marker = METHODS[cell.method].style
    if cell.cost_scale == "none":
        colour = UNSCALED[cell.method]
    if cell.tau is not None and cell.tau < 1:
        line = ":"
    return colour, line, marker


def _position(axis: str, cell: Cell) -> float | None:
    """Return where a cell is on the axis; None if it does not depend on it."""
    if _is_option(axis):
        return float(json.loads(cell.options).get(axis, 0.0))
    value = getattr(cell, axis)
    return float(value) if value else None


def _is_option(axis: str) -> bool:
    return axis not in ("n_calibration", "gamma", "tau")
