"""The committed form of results: a tidy CSV, arrays beside it, and a manifest."""

import contextlib
import csv
import hashlib
import json
import platform
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.cells import Cell, Suite
from benchmarks.machine import describe_machine
from benchmarks.runner import PACKAGES, git_commit
from benchmarks.schema import (
    CELL_COLUMNS,
    COLUMNS,
    TEXT_COLUMNS,
    as_text,
    check_row,
    check_scores,
    from_text,
)
from benchmarks.store import Results, read_mapping
from sbi_rope._files import read_arrays, write_atomically
from sbi_rope.errors import InvalidInputError

__all__ = [
    "COUNTED",
    "Rows",
    "Table",
    "markdown",
    "number_text",
    "read_table",
    "restore_cells",
    "with_numbers",
    "write_table",
]

Rows = dict[Cell, dict[str, Any]]
Arrays = dict[Cell, dict[str, np.ndarray]]

ARRAYS = "arrays.npz"
CHECKSUM = "sha256 of the lines of results.csv"
COUNTED = ("finished", "failed", "not run")


class Table(NamedTuple):
    """The cells of a suite that were run, and what belongs to them.

    Attributes:
        rows: One row a cell, in the order of the suite; see `schema.py` for its
            columns. The index holds the cells.
        arrays: By cell: log-probabilities, coverage, samples of one posterior.
    """

    rows: pd.DataFrame
    arrays: Arrays

    @classmethod
    def of(cls, rows: Rows, arrays: Arrays) -> "Table":
        """Return the table of some rows."""
        # Cells are no sequences, but an index of objects has to be asked for.
        index = pd.Index([*rows], dtype=object)
        values = [[row.get(name) for name in COLUMNS] for row in rows.values()]
        frame = pd.DataFrame(values, index=index, columns=[*COLUMNS], dtype=object)
        return cls(frame, arrays)

    @property
    def finished(self) -> pd.DataFrame:
        """The rows that have scores, with numbers as numbers."""
        return with_numbers(self.rows[self.rows["status"] == "finished"])

    def statuses(self, cells: Iterable[Cell]) -> list[str]:
        """Return "finished", "failed" or "not run" for each cell."""
        known = self.rows["status"].to_dict()
        return [known.get(cell, "not run") for cell in cells]

    def not_run(self, suite: Suite) -> list[Cell]:
        """Return the cells of a suite without a row."""
        known = set(self.rows.index)
        return [cell for cell in suite.cells if cell not in known]


def with_numbers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of objects with numbers as numbers, and texts as they were."""
    typed = rows.infer_objects()
    # pandas keeps each column of its own type for texts apart, and then takes ten times
    # as long for every selection of rows. The copy puts columns of a type together.
    typed[[*TEXT_COLUMNS]] = rows[[*TEXT_COLUMNS]]
    return typed.copy()


def write_table(suite: Suite, results: Results, folder: Path) -> Table:
    """Collect the results of a suite into `folder`: CSV, arrays, manifest."""
    found = {cell: results.load(cell) for cell in suite.cells}
    known = {cell: result for cell, result in found.items() if result is not None}
    table = Table.of(
        {cell: {"suite": suite.name, **row} for cell, (row, _) in known.items()},
        {c: parts for c, (row, parts) in known.items() if row["status"] == "finished"},
    )
    texts = table.rows.apply(lambda column: column.map(as_text))
    with write_atomically(folder / "results.csv") as path:
        texts.to_csv(path, index=False, lineterminator="\r\n", encoding="utf-8")
    flat = {
        f"{cell.key}/{name}": values
        for cell, parts in table.arrays.items()
        for name, values in parts.items()
    }
    with write_atomically(folder / ARRAYS) as path, path.open("wb") as file:
        np.savez_compressed(file, **flat)  # type: ignore[arg-type]
    statuses = table.statuses(suite.cells)
    manifest = {
        "suite": suite.name,
        "cells": len(suite.cells),
        **{status: statuses.count(status) for status in COUNTED},
        "written": time.strftime("%Y-%m-%dT%H:%M:%S"),
        "machine": describe_machine(threads=1),
        "system": platform.platform(),
        "packages": list(PACKAGES),
        "git commit of this table": git_commit(),
        "git commits of the cells": sorted(table.rows["git_commit"].dropna().unique()),
        CHECKSUM: _checksum(folder / "results.csv"),
    }
    with write_atomically(folder / "manifest.json") as path:
        path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return table


def read_table(suite: Suite, folder: Path) -> Table:
    """Read what :func:`write_table` wrote, and check that nobody changed it.

    Without a manifest, or without arrays as well, what they would tell is not checked.

    Raises:
        InvalidInputError: If the table was changed or is damaged. It names the file,
            and the row and column where they are known.
    """
    path = folder / "results.csv"
    try:
        rows = _read_rows(suite, path)
        arrays = _read_arrays(suite, rows, folder / ARRAYS)
        _check_manifest(rows, path, folder / "manifest.json")
    except (ValueError, csv.Error) as error:
        raise InvalidInputError(
            f"Expected {path} as `run` wrote it; {error}. Write it again with "
            f"`python -m benchmarks run {suite.name} --out {folder.parent}`, or undo "
            "the change."
        ) from error
    return Table.of(rows, arrays)


def restore_cells(table: Table, results: Results) -> int:
    """Write the cells of a table, finished or failed, as results that a run keeps.

    Results that are there already are not replaced. Finished cells whose arrays are not
    in the table are left out, because a run could not make tables of them.

    Returns:
        The number of cells that were written.
    """
    written = 0
    for cell, row in table.rows.iterrows():
        arrays = table.arrays.get(cell, {})
        incomplete = row["status"] == "finished" and not arrays
        if incomplete or results.read(cell):
            continue
        results.write(cell, row.drop("suite").to_dict(), arrays)
        written += 1
    return written


# Checks of what was read -------------------------------------------------------------


def _read_rows(suite: Suite, path: Path) -> Rows:
    known = set(suite.cells)
    rows: Rows = {}
    # Not by pandas, which fills rows that are too short, and cuts others silently.
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(
                f"expected the columns {', '.join(COLUMNS)}; got "
                f"{', '.join(reader.fieldnames or ('none',))}"
            )
        # Row 1 holds the names, as in a spreadsheet.
        for number, line in enumerate(reader, 2):
            with _naming(f"row {number}"):
                if None in line or None in line.values():
                    raise ValueError(f"expected {len(COLUMNS)} entries")
                row = {name: from_text(name, text) for name, text in line.items()}
                check_row(row)
                cell = Cell(**{name: row[name] for name in CELL_COLUMNS})
                if row["suite"] != suite.name:
                    raise ValueError(
                        f"column suite: expected {suite.name}; got {row['suite']!r}"
                    )
                if cell not in known:
                    raise ValueError(f"{cell} is no cell of the suite {suite.name}")
                if cell in rows:
                    first = [*rows].index(cell) + 2
                    raise ValueError(f"{cell} is in row {first} already")
            rows[cell] = row
    return rows


def _read_arrays(suite: Suite, rows: Rows, path: Path) -> Arrays:
    arrays: Arrays = {cell: {} for cell in rows}
    if not path.exists():
        return arrays
    by_key = {cell.key: cell for cell in suite.cells}
    with _naming(path.name):
        archive = read_arrays(path)
    for name, values in archive.items():
        key, _, part = name.partition("/")
        cell = by_key.get(key)
        if cell not in rows:
            raise ValueError(
                f"the row of {cell or key} is missing; its arrays are there"
            )
        arrays[cell][part] = values
    for number, (cell, row) in enumerate(rows.items(), 2):
        with _naming(f"row {number} ({cell})"):
            if row["status"] == "finished":
                check_scores(row, cell, arrays[cell])
            elif arrays[cell]:
                raise ValueError("column status: expected finished; got failed")
    return arrays


def _check_manifest(rows: Rows, path: Path, manifest: Path) -> None:
    if not manifest.exists():
        return
    with _naming(manifest.name):
        expected = read_mapping(manifest)
    if expected.get("finished") and not (path.parent / ARRAYS).exists():
        raise ValueError(f"{ARRAYS} is missing")
    statuses = [row["status"] for row in rows.values()]
    for status in ("finished", "failed"):
        if expected.get(status) != statuses.count(status):
            raise ValueError(
                f"expected {expected.get(status)} rows with status {status}, as "
                f"{manifest.name} says; got {statuses.count(status)}"
            )
    # Tables that were written before there was one have none.
    if expected.get(CHECKSUM, _checksum(path)) != _checksum(path):
        raise ValueError(
            "an entry was changed by hand: its checksum is not the one in "
            f"{manifest.name}"
        )


@contextlib.contextmanager
def _naming(where: str) -> Iterator[None]:
    """Say in an error where it was found."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _checksum(path: Path) -> str:
    # Of lines: git may give a text file other line ends.
    lines = path.read_text(encoding="utf-8").splitlines()
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


# Texts -------------------------------------------------------------------------------


def markdown(
    head: Sequence[str], lines: Iterable[Iterable[object]], *, rule: str = "---"
) -> list[str]:
    """Return a table in Markdown; ``rule`` is below each column of the head."""
    first, *entries = (f"| {' | '.join(map(str, line))} |" for line in (head, *lines))
    return [first, f"|{'|'.join([rule] * len(head))}|", *entries]


def number_text(values: pd.Series, form: str) -> str:
    """Return the mean over repetitions and, of several, the standard deviation.

    One -inf makes the mean -inf, without a spread.
    """
    mean = float(values.mean())
    if len(values) < 2 or not np.isfinite(mean):
        return f"{mean:{form}}"
    return f"{mean:{form}} ± {values.std():{form.lstrip('+')}}"
