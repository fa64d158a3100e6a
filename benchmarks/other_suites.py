"""What the suites beside `main` say, a small table each."""

import functools
import json
from collections.abc import Callable
from typing import NamedTuple

import pandas as pd

from benchmarks.cells import Cell
from benchmarks.methods import methods_where
from benchmarks.published import (
    MISSING,
    SIZE,
    Published,
    both_texts,
    entry,
    gap,
    lpp_text,
    table,
)
from benchmarks.schema import WHERE

__all__ = ["other_suites"]


def _above_npe(published: Published, rows: pd.DataFrame) -> str:
    task = rows["task"].iloc[0]
    npe = published.select("NPE", suite="wellspecified", task=task)
    difference = gap(rows, npe)
    return MISSING if difference is None else f"{difference:+.2f}"


def _weight(cell: Cell) -> str:
    weight = json.loads(cell.options).get("misspecification_weight")
    return "prior shifted" if weight is None else f"weight {weight:g}"


def _unit(cell: Cell) -> str:
    unit = "embedding" if cell.cost_scale == "none" else "median distance"
    return f"in units of the {unit}"


class Grid(NamedTuple):
    """A small table of a suite: what is in its lines, columns and entries.

    Attributes:
        what: What the table shows.
        column: What differs from column to column.
        line: What differs from line to line, besides the task.
        beside: Methods whose LPP on the same data stands in the name of a line.
        text: An entry.
        methods: Those that are shown.
        all_sizes: Whether to show all numbers of calibration pairs.
    """

    what: str
    column: Callable[[Cell], float]
    line: Callable[[Cell], str]
    beside: tuple[str, ...] = ()
    text: Callable[[Published, pd.DataFrame], str] = lambda _, rows: both_texts(rows)
    methods: tuple[str, ...] = ("RoPE",)
    all_sizes: bool = False


GRIDS = {
    "gamma": Grid(
        f"RoPE, {SIZE} pairs, by gamma: LPP (ACAUC).",
        column=lambda cell: cell.gamma or 0.0,
        line=_unit,
        beside=("prior", "SBI"),
    ),
    "tau": Grid(
        f"RoPE, {SIZE} pairs, by tau: LPP (ACAUC).",
        column=lambda cell: cell.tau or 0.0,
        line=_weight,
        beside=("prior", "NPE"),
    ),
    "wellspecified": Grid(
        "RoPE above NPE, by calibration pairs.",
        column=lambda cell: cell.n_calibration,
        line=lambda cell: f"tau {cell.tau:g}",
        beside=("prior", "NPE"),
        text=_above_npe,
        all_sizes=True,
    ),
    "labels": Grid(
        f"LPP with {SIZE} pairs, by noise on their labels in %.",
        column=lambda cell: 100 * json.loads(cell.options).get("label_noise", 0.0),
        line=lambda cell: cell.method,
        text=lambda _, rows: lpp_text(rows),
        methods=methods_where(lambda entry: entry.pairs),
    ),
}


def other_suites(published: Published) -> list[str]:
    """Return a small table of each suite that one is defined for, and that has rows."""
    lines = []
    for name, grid in GRIDS.items():
        lines += ["", f"### {published.suites[name].title}", ""]
        if len(published.rows[name]):
            lines += [grid.what, "", *_grid(published, name, grid)]
        else:
            lines += ["Not run."]
    return lines


def _grid(published: Published, suite: str, grid: Grid) -> list[str]:
    @functools.cache  # of rows of the same data, of which each would select them anew
    def name_of(task: str, variant: str, options: str, line: str) -> str:
        same = {"task": task, "variant": variant, "options": options}
        lpps = [
            f"{other} {entry(published.select(other, suite=suite, **same), lpp_text)}"
            for other in grid.beside
        ]
        text = f"{published.name(task, suite=suite)}, {line}"
        return text + (f" ({', '.join(lpps)})" if lpps else "")

    rows = published.rows[suite]
    rows = rows[rows["method"].isin(grid.methods)]
    rows = rows[grid.all_sizes | (rows["n_calibration"] == SIZE)]
    names = [
        name_of(cell.task, cell.variant, cell.options, grid.line(cell))
        for cell in rows.index
    ]
    places = [names, rows.index.map(grid.column)]
    counts = rows.groupby([*WHERE])["repetition"].nunique()
    entries = {
        place: entry(
            part,
            functools.partial(grid.text, published),
            out_of=counts[tuple(part[[*WHERE]].iloc[0])],
        )
        for place, part in rows.groupby(places)
    }
    columns = sorted({column for _, column in entries})
    lines = [
        [line, *(entries.get((line, column), MISSING) for column in columns)]
        for line in dict.fromkeys(names)
    ]
    return table(("", *(f"{column:g}" for column in columns)), lines)
