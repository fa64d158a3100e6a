"""Committed tables, in the words that the summary speaks of them."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.cells import Suite, list_suites, load_suite
from benchmarks.tables import Table, group_by, mean_and_spread, read_table

__all__ = [
    "FIXED",
    "LETTERS",
    "MISSING",
    "PAPER",
    "SIZE",
    "TASKS",
    "Published",
    "Row",
    "Setting",
    "acauc_text",
    "both_texts",
    "entry",
    "finished",
    "gap",
    "lpp_text",
    "mean",
    "name_of",
    "number_text",
    "table",
]

Row = dict[str, Any]

SIZE = 50
MISSING = "-"

# The paper's letters; G is ours.
TASKS = {
    "A": "cs",
    "B": "sir",
    "C": "pendulum",
    "D": "hemodynamics",
    "E": "light_tunnel",
    "F": "wind_tunnel",
    "G": "light_tunnel_sensors",
}
LETTERS = {task: letter for letter, task in TASKS.items()}


class Setting(NamedTuple):
    """A setting of the coupling."""

    gamma: float
    tau: float
    cost_scale: str

    def __str__(self) -> str:
        scale = " of the embedding" if self.cost_scale == "none" else ""
        return f"gamma {self.gamma:g}{scale}, tau {self.tau:g}"


FIXED = Setting(0.1, 1.0, "simulated")
PAPER = Setting(0.5, 1.0, "none")


@dataclass(frozen=True)
class Published:
    """The suites, and the tables of those that were run."""

    suites: dict[str, Suite]
    tables: dict[str, Table]

    @classmethod
    def read(cls, folder: Path) -> "Published":
        """Read the tables in a folder of suites."""
        suites = {name: load_suite(name) for name in list_suites()}
        there = [name for name in suites if (folder / name / "results.csv").exists()]
        if not there:
            raise SystemExit(f"No results in {folder}. Use `run` first, or --out.")
        return cls(
            suites, {name: read_table(suites[name], folder / name) for name in there}
        )

    @cached_property
    def rows(self) -> dict[str, list[Row]]:
        """Rows by suite, of the repetitions in which a task is complete.

        Of all repetitions where none is: a mean over more of them for one method than
        for the next would compare data, not methods.
        """
        rows: dict[str, list[Row]] = {name: [] for name in self.suites}
        for name, table in self.tables.items():
            cells = self.suites[name].cells
            for group in group_by(cells, "task", "variant").values():
                runs = list(group_by(group, "repetition").values())
                whole = [run for run in runs if all(cell in table.rows for cell in run)]
                kept = [cell for run in whole or runs for cell in run]
                rows[name] += [table.rows[c] for c in kept if c in table.rows]
        return rows

    def select(
        self,
        method: str,
        *,
        suite: str = "main",
        size: int = SIZE,
        setting: Setting = FIXED,
        **fields: str,
    ) -> list[Row]:
        """Return the rows of a method, one a repetition."""
        return [
            row
            for row in self.rows[suite]
            if row["method"] == method
            and row["n_calibration"] in (0, size)
            and row["gamma"] in (None, setting.gamma)
            and row["tau"] in (None, setting.tau)
            and row["cost_scale"] in ("", setting.cost_scale)
            and all(row[name] == value for name, value in fields.items())
        ]

    def above(self, method: str, other: str, **chosen: Any) -> float | None:
        """Return how far the LPP of a method is above that of another."""
        return gap(self.select(method, **chosen), self.select(other, **chosen))

    def sizes(self, task: str, *, suite: str = "main") -> list[int]:
        """Return the numbers of calibration pairs that a task is to be run with."""
        cells = self.suites[suite].cells
        return sorted({c.n_calibration for c in cells if c.task == task} - {0})

    def name(self, task: str, *, suite: str = "main") -> str:
        """Return a task's letter, marked if a model stands in for recorded data."""
        stands_in = any(r["stand_in"] for r in self.rows[suite] if r["task"] == task)
        return LETTERS[task] + (" (stand-in)" if stands_in else "")


def finished(rows: Iterable[Row]) -> list[Row]:
    """Return the rows that have scores."""
    return [row for row in rows if row["status"] == "finished"]


def mean(rows: Iterable[Row], column: str = "lpp_z") -> float | None:
    """Return the mean over repetitions; None of no rows."""
    values = [row[column] for row in finished(rows)]
    return sum(values) / len(values) if values else None


def gap(ours: Iterable[Row], theirs: Iterable[Row]) -> float | None:
    """Return the mean difference in LPP over the repetitions that both have."""
    other = {row["repetition"]: row["lpp_z"] for row in finished(theirs)}
    pairs = [
        (row["lpp_z"], other[row["repetition"]])
        for row in finished(ours)
        if row["repetition"] in other
    ]
    # Two that are -inf do not differ.
    differences = [0.0 if a == b == -math.inf else a - b for a, b in pairs]
    return sum(differences) / len(pairs) if pairs else None


# Texts ------------------------------------------------------------------------------


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """Return a table in Markdown."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)]


def name_of(published: Published, task: str, *, suite: str = "main") -> str:
    """Name a task with its letter, marked if a model stands in for it."""
    letter, *mark = published.name(task, suite=suite).split(" ", 1)
    return " ".join([letter, task, *mark])


def entry(rows: Sequence[Row], text: Callable[[Sequence[Row]], str]) -> str:
    """Return scores as text, with what failed."""
    scored = finished(rows)
    if not scored:
        return "failed" if rows else MISSING
    failed = len(rows) - len(scored)
    return text(scored) + (f" ({failed} of {len(rows)} failed)" if failed else "")


def lpp_text(rows: Sequence[Row]) -> str:
    """Return the LPP over repetitions, and whether a coupling has not converged."""
    text = number_text([row["lpp_z"] for row in rows], ".2f")
    return text + ("" if all(r["converged"] for r in rows) else " (not converged)")


def acauc_text(rows: Sequence[Row]) -> str:
    """Return the ACAUC over repetitions."""
    return number_text([row["acauc"] for row in rows], "+.3f")


def number_text(values: list[float], form: str) -> str:
    """Return a mean with its spread, if there is one."""
    value, spread = mean_and_spread(values)
    text = f"{value:{form}}"
    return text if math.isnan(spread) else f"{text} ± {spread:{form.lstrip('+')}}"


def both_texts(rows: Sequence[Row]) -> str:
    """Return the mean LPP with the mean ACAUC in brackets."""
    return f"{mean(rows):.2f} ({mean(rows, 'acauc'):+.2f})"
