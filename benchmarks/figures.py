"""The figures of a suite."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from benchmarks.cells import Cell, Suite, data_in_words
from benchmarks.methods import METHODS
from benchmarks.schema import WHERE
from benchmarks.table import Table
from sbi_rope import plots
from sbi_rope._files import write_atomically

__all__ = ["LPPAxis", "curves", "draw_all", "save"]

# With the distances as they are, as in the paper.
UNSCALED = {"RoPE": "#003050", "OT-only": "#2A6F97"}
# Lines that differ in calibration pairs only.
MARKERS = {10: "o", 50: "s", 200: "^", 1000: "D"}
# More labels than these run into each other.
MAX_TICKS = 5
# More panels than this go to another row.
MAX_COLUMNS = 9
# Lines of a legend in an inch of height.
LEGEND_LINES = 4.5
# Calibration pairs behind calibration curves and corner plots, where there is a choice.
SHOWN_PAIRS = 50
# Methods in corner plots.
CORNERS = ("NPE", "RoPE", "stack", "prior")
# More parameters than these make a corner plot that nobody can read.
MAX_PARAMETERS = 6


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


def draw_all(suite: Suite, table: Table, folder: Path) -> list[tuple[str, str]]:
    """Draw the figures of a suite; return their files and what they show."""
    rows = table.finished
    if not len(rows):
        return []
    drawn = []
    for name, what, figure in (
        (
            f"{suite.x_axis}.png",
            f"LPP and ACAUC against {suite.x_axis}",
            curves(suite.x_axis, rows),
        ),
        ("calibration.png", "Coverage of central intervals", _coverage(table)),
        *_corners(table),
    ):
        if figure is None:
            continue
        save(figure, folder / name)
        drawn.append((name, what))
    return drawn


def _grid(count: int, max_columns: int = MAX_COLUMNS) -> tuple[int, int]:
    """Return rows and columns for so many panels; wide figures are wrapped."""
    rows = math.ceil(count / max_columns)
    return rows, math.ceil(count / rows)


def save(figure: Figure, path: Path) -> None:
    """Write a figure without metadata, so that the same table gives the same bytes."""
    with write_atomically(path) as temporary:
        figure.savefig(temporary, format="png", dpi=90, metadata={"Software": None})


def curves(axis: str, rows: pd.DataFrame, *, max_columns: int = MAX_COLUMNS) -> Figure:
    """Draw LPP and ACAUC against a column, a panel for each task and variant."""
    panels = ["task"] if _is_option(axis) else WHERE
    groups = rows.groupby(panels, sort=False)
    bands, columns = _grid(len(groups), max_columns)
    figure = Figure(figsize=(3.1 * columns + 1.9, 5.4 * bands), layout="constrained")
    axes = figure.subplots(2 * bands, columns, squeeze=False, sharex="col")
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
        axes[1, column].tick_params(labelbottom=True)
        for part in axes[:, column]:
            part.spines[["top", "right"]].set_visible(False)
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
    ticks = [scale.prior]
    step = _round_down((high - scale.prior) / 3) if high > scale.prior else 0.0
    if step > 0:
        start = math.ceil(scale.prior / step) * step
        ticks += [t for t in np.arange(start, high, step) if t - scale.prior > step / 2]
    distance = _round_down(2 * scale.unit)
    while scale.prior - distance > low:
        ticks.append(round(scale.prior - distance, 3))
        distance *= 3
    axes.set_yticks(ticks, [f"{tick:.3g}" for tick in ticks])


def _round_down(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power


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


# Calibration curves and corner plots ------------------------------------------------


def _shown(table: Table, array: str) -> dict[tuple[str, ...], dict[str, Cell]]:
    """By task: a cell of each method, all with about as many calibration pairs."""
    shown: dict[tuple[str, ...], dict[str, Cell]] = {}
    for where, rows in table.finished.groupby(WHERE, sort=False):
        nearest = {
            name: min(part.index, key=_distance)
            for name, part in rows.groupby("method", sort=False)
        }
        shown[where] = {n: c for n, c in nearest.items() if array in table.arrays[c]}
    return {where: cells for where, cells in shown.items() if cells}


def _distance(cell: Cell) -> tuple[Any, ...]:
    pairs = abs(cell.n_calibration - SHOWN_PAIRS)
    return pairs, cell.cost_scale != "simulated", -(cell.tau or 0), cell.repetition


def _coverage(table: Table) -> Any:
    shown = _shown(table, "coverage")
    if not shown:
        return None
    bands, columns = _grid(len(shown))
    height = 3.4 + 4.2 * (bands - 1)
    figure = Figure(figsize=(3.0 * columns + 1.9, height), layout="constrained")
    axes = figure.subplots(bands, columns, squeeze=False).flatten()
    for part in axes[len(shown) :]:
        part.set_axis_off()
    levels = np.arange(1, 100) / 100
    seen: dict[str, Any] = {}
    for part, (where, cells) in zip(axes, shown.items(), strict=False):
        part.plot([0, 1], [0, 1], color="0.6", lw=0.8)
        for name, cell in cells.items():
            colour, line, _ = _style(cell)
            curve = table.arrays[cell]["coverage"]
            (handle,) = part.plot(levels, curve, color=colour, ls=line, lw=1.4)
            seen.setdefault(name, handle)
        part.set(xlim=(0, 1), ylim=(0, 1), box_aspect=1)
        part.set_title("\n".join(data_in_words(*where)))
        part.set_xlabel("credible level")
        part.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("share of true parameters inside")
    _add_legend(figure, seen)
    return figure


def _corners(table: Table) -> Iterator[tuple[str, str, Any]]:
    for where, cells in _shown(table, "samples").items():
        arrays = {name: table.arrays[c] for name, c in cells.items() if name in CORNERS}
        if "RoPE" not in arrays:
            continue
        scores = table.rows["acauc_per_parameter"][cells["RoPE"]].split("; ")
        names = [score.split("=")[0] for score in scores]
        shown = slice(MAX_PARAMETERS)
        samples = {
            n: torch.from_numpy(a["samples"])[:, shown] for n, a in arrays.items()
        }
        prior = samples.pop("prior", None)
        theta = torch.from_numpy(arrays["RoPE"]["theta"])[shown]
        name = "-".join(data_in_words(*where))
        name = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
        figure = plots.pair_plot(
            samples, theta, prior=prior, parameter_names=names[shown]
        )
        what = f"Posteriors of one observation, {name}"
        if len(names) > MAX_PARAMETERS:
            what += f", the first {MAX_PARAMETERS} of {len(names)} parameters"
        yield f"corner-{name}.png", what, figure
