"""The figures of a suite."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.cells import Cell, Suite
from benchmarks.tables import Table, group_by, mean_and_spread
from sbi_rope import plots
from sbi_rope._files import write_atomically

__all__ = ["LPPAxis", "draw_all"]

STYLES = {
    "stack": ("black", "-", "*"),
    "stack of a batch": ("black", "--", "*"),
    "RoPE": ("#0072B2", "-", "o"),
    "OT-only": ("#56B4E9", "--", "s"),
    "tuning-only": ("#009E73", "--", "^"),
    "fine-tuned NPE": ("#E69F00", "-", "D"),
    "discrepancy": ("#882255", "-", "h"),
    "discrepancy (input)": ("#882255", "--", "h"),
    "discrepancy (tuned)": ("#882255", "-.", "h"),
    "discrepancy, prior learned": ("#882255", ":", "h"),
    "discrepancy, fine-tuned": ("#AA4499", "-", "p"),
    "J-NPE": ("#CC79A7", "-.", "v"),
    "MLP": ("0.35", ":", "x"),
    "NPE": ("#D55E00", "--", None),
    "NNPE": ("#8B4513", "-.", None),
    "RNPE": ("#8B4513", ":", None),
    "NPE-RS": ("#7F3C8D", ":", None),
    "HVAE": ("#117733", "-.", "P"),
}
# With the distances as they are, as in the paper.
UNSCALED = {"RoPE": "#003050", "OT-only": "#2A6F97"}
# Lines that differ in calibration pairs only.
MARKERS = {10: "o", 50: "s", 200: "^", 1000: "D"}
# More labels than these run into each other.
MAX_TICKS = 6
# More panels than this go to another row.
MAX_COLUMNS = 9
REFERENCES = {"prior": ("0.6", "prior"), "SBI": ("black", "SBI")}
# Calibration pairs behind calibration curves and corner plots, where there is a choice.
SHOWN_PAIRS = 50


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
    rows = {c: r for c, r in table.rows.items() if r["status"] == "finished"}
    if not rows:
        return []
    drawn = []
    for name, what, figure in (
        (
            f"{suite.x_axis}.png",
            f"LPP and ACAUC against {suite.x_axis}",
            _curves(suite.x_axis, rows),
        ),
        ("calibration.png", "Coverage of central intervals", _coverage(rows, table)),
        *_corners(rows, table),
    ):
        if figure is None:
            continue
        with write_atomically(folder / name) as path:
            # No metadata: the same table has to give the same bytes.
            figure.savefig(path, format="png", dpi=90, metadata={"Software": None})
        drawn.append((name, what))
    return drawn


def _grid(count: int) -> tuple[int, int]:
    """Return rows and columns for so many panels; wide figures are wrapped."""
    rows = math.ceil(count / MAX_COLUMNS)
    return rows, math.ceil(count / rows)


def _curves(axis: str, rows: dict[Cell, dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    panels = ("task",) if _is_option(axis) else ("task", "variant", "options")
    groups = group_by(rows, *panels)
    bands, columns = _grid(len(groups))
    figure = Figure(figsize=(3.1 * columns + 1.9, 5.4 * bands), layout="constrained")
    axes = figure.subplots(2 * bands, columns, squeeze=False, sharex="col")
    # Side by side, as if nothing was wrapped.
    axes = np.concatenate(np.split(axes, bands), axis=1)
    for part in axes[:, len(groups) :].flat:
        part.set_axis_off()
    seen: dict[str, Any] = {}
    for column, (where, cells) in enumerate(groups.items()):
        title = "\n".join(str(part) for part in where if part not in ("", "{}"))
        if any(rows[cell]["stand_in"] for cell in cells):
            title += "\n(stand-in)"
        axes[0, column].set_title(title, size="medium")
        _panel(axes[0, column], axis, cells, rows, "lpp_z", seen)
        _panel(axes[1, column], axis, cells, rows, "acauc", seen)
        axes[1, column].axhline(0, color="0.6", lw=0.8)
        axes[1, column].set_xlabel(axis.replace("_", " "))
        for part in axes[:, column]:
            part.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("LPP, in prior sd")
    axes[1, 0].set_ylabel("ACAUC (0 is calibrated)")
    figure.legend(seen.values(), seen.keys(), loc="outside right center", frameon=False)
    return figure


def _panel(
    axes: Any,
    axis: str,
    cells: list[Cell],
    rows: dict[Cell, dict[str, Any]],
    score: str,
    seen: dict[str, Any],
) -> None:
    lines = _lines(axis, cells)
    values = [rows[c][score] for c in cells if math.isfinite(rows[c][score])]
    positions = sorted({_position(axis, c) for c in cells} - {None})
    if not values or not positions:
        return
    if score == "lpp_z":
        prior = _mean_of("prior", cells, rows, default=min(values))
        top = _mean_of("SBI", cells, rows, default=prior)
        scale = LPPAxis(prior, max(top, max(values)))
        axes.set_yscale("function", functions=(scale.forward, scale.inverse))
        bottom = scale.inverse(scale.forward(min(values)) - 0.1)
        axes.set_ylim(bottom, scale.inverse(scale.forward(max(values)) + 0.1))
        _set_ticks(axes, scale, min(values), max(values))
    for label, group in lines.items():
        colour, line, marker = _style(group[0])
        if axis != "n_calibration" and group[0].n_calibration:
            marker = MARKERS.get(group[0].n_calibration, marker)
        points = _points(axis, group, rows, score)
        if not points:
            mean, _ = mean_and_spread([rows[c][score] for c in group])
            if not math.isfinite(mean):
                (handle,) = axes.plot(
                    positions, [axes.get_ylim()[0]] * len(positions), "v", color=colour
                )
                seen.setdefault(label, handle)
                continue
            handle = axes.axhline(mean, color=colour, ls=line, lw=1.3)
        else:
            x, y, spread = zip(*points, strict=True)
            handle = axes.errorbar(
                x, y, spread, color=colour, ls=line, marker=marker, ms=4, lw=1.6
            )
            lost = [p for p, v in zip(x, y, strict=True) if not math.isfinite(v)]
            axes.plot(lost, [axes.get_ylim()[0]] * len(lost), "v", color=colour)
        seen.setdefault(label, handle)
    if positions[0] > 0 and positions[-1] / positions[0] >= 8:
        axes.set_xscale("log")
    turned = 90 if len(positions) > MAX_TICKS else 0
    axes.set_xticks(positions, [f"{p:g}" for p in positions], rotation=turned)
    axes.minorticks_off()


def _mean_of(
    method: str, cells: list[Cell], rows: dict[Cell, dict[str, Any]], default: float
) -> float:
    values = [rows[c]["lpp_z"] for c in cells if c.method == method]
    values = [value for value in values if math.isfinite(value)]
    return sum(values) / len(values) if values else default


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


def _lines(axis: str, cells: list[Cell]) -> dict[str, list[Cell]]:
    """Group cells into lines: all that is not on the axis tells them apart."""
    lines: dict[str, list[Cell]] = {}
    several = {
        name: len({getattr(c, name) for c in cells if c.method == "RoPE"}) > 1
        for name in ("gamma", "tau", "cost_scale", "n_calibration")
    }
    for cell in cells:
        label = cell.method
        for name in ("gamma", "tau", "n_calibration"):
            value = getattr(cell, name)
            if several[name] and name != axis and value:
                label += f", {name.replace('n_calibration', 'n_c')} {value:g}"
        if several["cost_scale"] and cell.cost_scale == "none":
            label += ", unscaled"
        lines.setdefault(label, []).append(cell)
    return lines


def _style(cell: Cell) -> tuple[str, str, str | None]:
    if cell.method in REFERENCES:
        return REFERENCES[cell.method][0], "-", None
    colour, line, marker = STYLES[cell.method]
    if cell.cost_scale == "none":
        colour = UNSCALED[cell.method]
    if cell.tau is not None and cell.tau < 1:
        line = ":"
    return colour, line, marker


def _points(
    axis: str, cells: list[Cell], rows: dict[Cell, dict[str, Any]], score: str
) -> list[tuple[float, float, float]]:
    values: dict[float, list[float]] = {}
    for cell in cells:
        position = _position(axis, cell)
        if position is not None:
            values.setdefault(position, []).append(rows[cell][score])
    points = []
    for position in sorted(values):
        mean, spread = mean_and_spread(values[position])
        points.append((position, mean, 0.0 if math.isnan(spread) else spread))
    return points


def _position(axis: str, cell: Cell) -> float | None:
    """Return where a cell is on the axis; None if it does not depend on it."""
    if _is_option(axis):
        return float(json.loads(cell.options).get(axis, 0.0))
    value = getattr(cell, axis)
    return float(value) if value else None


def _is_option(axis: str) -> bool:
    return axis not in ("n_calibration", "gamma", "tau")


# Calibration curves and corner plots ------------------------------------------------


def _shown(rows: Iterable[Cell]) -> dict[tuple[Any, ...], dict[str, Cell]]:
    """By task: a cell of each method, all with about as many calibration pairs."""
    shown: dict[tuple[Any, ...], dict[str, Cell]] = {}
    for where, cells in group_by(rows, "task", "variant", "options").items():
        chosen: dict[str, Cell] = {}
        for cell in cells:
            best = chosen.get(cell.method)
            if best is None or _distance(cell) < _distance(best):
                chosen[cell.method] = cell
        shown[where] = chosen
    return shown


def _distance(cell: Cell) -> tuple[Any, ...]:
    pairs = abs(cell.n_calibration - SHOWN_PAIRS)
    return pairs, cell.cost_scale != "simulated", -(cell.tau or 0), cell.repetition


def _coverage(rows: dict[Cell, dict[str, Any]], table: Table) -> Any:
    from matplotlib.figure import Figure

    shown = {
        where: {n: c for n, c in cells.items() if "coverage" in table.arrays[c]}
        for where, cells in _shown(rows).items()
    }
    shown = {where: cells for where, cells in shown.items() if cells}
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
        title = "\n".join(str(w) for w in where if w not in ("", "{}"))
        part.set(xlim=(0, 1), ylim=(0, 1), box_aspect=1, title=title)
        part.set_xlabel("credible level")
        part.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("share of true parameters inside")
    figure.legend(seen.values(), seen.keys(), loc="outside right center", frameon=False)
    return figure


def _corners(
    rows: dict[Cell, dict[str, Any]], table: Table
) -> Iterable[tuple[str, str, Any]]:
    for where, cells in _shown(rows).items():
        arrays = {
            name: table.arrays[cell]
            for name, cell in cells.items()
            if name in ("NPE", "RoPE", "fine-tuned NPE", "prior")
            and "samples" in table.arrays[cell]
        }
        if "RoPE" not in arrays:
            continue
        samples = {n: torch.from_numpy(a["samples"]) for n, a in arrays.items()}
        prior = samples.pop("prior", None)
        theta = torch.from_numpy(arrays["RoPE"]["theta"])
        name = "-".join(str(w) for w in where if w not in ("", "{}"))
        name = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
        scores = rows[cells["RoPE"]]["acauc_per_parameter"].split("; ")
        figure = plots.pair_plot(
            samples,
            theta,
            prior=prior,
            parameter_names=[score.split("=")[0] for score in scores],
        )
        yield f"corner-{name}.png", f"Posteriors of one observation, {name}", figure
