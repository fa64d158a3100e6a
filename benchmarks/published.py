"""Committed tables, in the words that the summary speaks of them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from benchmarks.cells import Cell, Suite, list_suites, load_suite
from benchmarks.table import Table, markdown, number_text, read_table, with_numbers

__all__ = [
    "FIXED",
    "LETTERS",
    "MISSING",
    "PAPER",
    "SIZE",
    "TASKS",
    "Published",
    "Setting",
    "acauc_text",
    "both_texts",
    "entry",
    "gap",
    "lpp_text",
    "mean",
    "num_repetitions",
    "runs_of",
    "table",
]

table = partial(markdown, rule=" --- ")

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

    @classmethod
    def of(cls, cell: Cell) -> "Setting":
        """Return the setting of a cell."""
        return cls(cell.gamma or 0.0, cell.tau or 0.0, cell.cost_scale)

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
    def rows(self) -> dict[str, pd.DataFrame]:
        """Rows by suite, of all repetitions that were run."""
        none = Table.of({}, {})
        return {
            name: with_numbers(self.tables.get(name, none).rows) for name in self.suites
        }

    @cached_property
    def _by_method(self) -> dict[str, dict[str, list[Cell]]]:
        return {name: rows.groupby("method").groups for name, rows in self.rows.items()}

    def select(
        self,
        method: str,
        *,
        suite: str = "main",
        size: int = SIZE,
        setting: Setting = FIXED,
        **fields: str,
    ) -> pd.DataFrame:
        """Return the rows of a method, one a repetition."""
        cells = self._cells(method, suite=suite, size=size, setting=setting, **fields)
        return self.rows[suite].loc[cells]

    def _cells(
        self, method: str, *, suite: str, size: int, setting: Setting, **fields: str
    ) -> list[Cell]:
        return [
            cell
            for cell in self._by_method[suite].get(method, [])
            if cell.n_calibration in (0, size)
            and (cell.gamma is None or Setting.of(cell) == setting)
            and all(getattr(cell, name) == value for name, value in fields.items())
        ]

    @cached_property
    def _scores(self) -> dict[str, dict[Cell, float]]:
        return {
            name: _finished(rows)["lpp_z"].to_dict() for name, rows in self.rows.items()
        }

    def above(
        self,
        method: str,
        other: str,
        *,
        suite: str = "main",
        size: int = SIZE,
        setting: Setting = FIXED,
        **fields: str,
    ) -> float | None:
        """Return how far the LPP of a method is above that of another."""
        # Thousands of these are asked for, and a row of pandas takes a millisecond.
        scores = self._scores[suite]
        of_each = [
            {
                cell.repetition: scores[cell]
                for cell in self._cells(
                    name, suite=suite, size=size, setting=setting, **fields
                )
                if cell in scores
            }
            for name in (method, other)
        ]
        return _mean_difference(*of_each)

    def sizes(self, task: str, *, suite: str = "main") -> list[int]:
        """Return the numbers of calibration pairs that a task is to be run with."""
        cells = self.suites[suite].cells
        return sorted({c.n_calibration for c in cells if c.task == task} - {0})

    def letter(self, task: str, *, suite: str = "main") -> str:
        """Return a task's letter, marked if a model stands in for recorded data."""
        return LETTERS[task] + (" (stand-in)" if task in self._stand_ins[suite] else "")

    @cached_property
    def _stand_ins(self) -> dict[str, set[str]]:
        """Tasks by suite, of which a model stands in for recorded data."""
        return {
            name: {*rows["task"][rows["stand_in"] == True]}  # noqa: E712
            for name, rows in self.rows.items()
        }

    def name(self, task: str, *, suite: str = "main") -> str:
        """Name a task with its letter, marked if a model stands in for it."""
        return self.letter(task, suite=suite).replace(
            LETTERS[task], f"{LETTERS[task]} {task}", 1
        )


def runs_of(suite: Suite) -> dict[tuple[str, str], list[list[Cell]]]:
    """Return the cells of each repetition, by task and variant."""
    runs: dict[tuple[str, str], dict[int, list[Cell]]] = {}
    for cell in suite.cells:
        where = runs.setdefault((cell.task, cell.variant), {})
        where.setdefault(cell.repetition, []).append(cell)
    return {where: [*parts.values()] for where, parts in runs.items()}


def num_repetitions(parts: Iterable[pd.DataFrame]) -> int:
    """Return the number of repetitions of which there are rows."""
    return len({repetition for part in parts for repetition in part["repetition"]})


def _finished(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["status"] == "finished"]


def mean(rows: pd.DataFrame, column: str = "lpp_z") -> float | None:
    """Return the mean over repetitions; None of no rows."""
    values = _finished(rows)[column]
    return float(values.mean()) if len(values) else None


def gap(ours: pd.DataFrame, theirs: pd.DataFrame) -> float | None:
    """Return the mean difference in LPP over the repetitions that both have."""
    finished = (_finished(rows) for rows in (ours, theirs))
    return _mean_difference(
        *(
            dict(zip(rows["repetition"], rows["lpp_z"], strict=True))
            for rows in finished
        )
    )


def _mean_difference(a: dict[int, float], b: dict[int, float]) -> float | None:
    # Two that are -inf do not differ.
    differences = [0.0 if a[k] == b[k] else a[k] - b[k] for k in a if k in b]
    return sum(differences) / len(differences) if differences else None


# Texts ------------------------------------------------------------------------------


def entry(
    rows: pd.DataFrame,
    text: Callable[[pd.DataFrame], str],
    *,
    out_of: int | None = None,
) -> str:
    """Return scores as text, with what failed.

    Args:
        rows: One a repetition.
        text: Makes a text of those that were finished.
        out_of: The number of repetitions of what it stands beside. If there are fewer
            rows, the entry says of how many it is.
    """
    scored = _finished(rows)
    if not len(scored):
        return "failed" if len(rows) else MISSING
    failed = len(rows) - len(scored)
    fewer = f" [{len(rows)}]" if out_of is not None and len(rows) < out_of else ""
    failures = f" ({failed} of {len(rows)} failed)" if failed else ""
    return text(scored) + fewer + failures


def lpp_text(rows: pd.DataFrame) -> str:
    """Return the LPP over repetitions, and whether a coupling has not converged."""
    text = number_text(rows["lpp_z"], ".2f")
    return text + ("" if rows["converged"].all() else " (not converged)")


def acauc_text(rows: pd.DataFrame) -> str:
    """Return the ACAUC over repetitions."""
    return number_text(rows["acauc"], "+.3f")


def both_texts(rows: pd.DataFrame) -> str:
    """Return the mean LPP with the mean ACAUC in brackets."""
    return f"{mean(rows):.2f} ({mean(rows, 'acauc'):+.2f})"
