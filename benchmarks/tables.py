"""The committed form of results: a tidy CSV, arrays beside it, and a manifest."""

import contextlib
import csv
import hashlib
import json
import math
import platform
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import Cell, Suite
from benchmarks.checks import check_scores, read_mapping
from benchmarks.machine import describe_machine
from benchmarks.runner import PACKAGES, git_commit
from benchmarks.schema import CELL_COLUMNS, COLUMNS, as_text, check_row, from_text
from benchmarks.store import Results
from sbi_rope._files import read_arrays, write_atomically
from sbi_rope.errors import InvalidInputError

__all__ = [
    "COLUMNS",
    "Table",
    "group_by",
    "mean_and_spread",
    "read_table",
    "write_table",
]

ARRAYS = "arrays.npz"
CHECKSUM = "sha256 of the lines of results.csv"


class Table:
    """The rows of a suite that were run, and what belongs to them.

    Attributes:
        rows: Values by column, in the order of the suite's cells.
        arrays: By cell: log-probabilities, coverage, samples of one posterior.
    """

    def __init__(
        self,
        rows: dict[Cell, dict[str, Any]],
        arrays: dict[Cell, dict[str, np.ndarray]],
    ) -> None:
        self.rows = rows
        self.arrays = arrays


def write_table(suite: Suite, results: Results, folder: Path) -> Table:
    """Collect the results of a suite into `folder`: CSV, arrays, manifest."""
    rows, arrays = {}, {}
    for cell in suite.cells:
        found = results.load(cell)
        if found is None:
            continue
        row, parts = found
        rows[cell] = {"suite": suite.name, **row}
        if row["status"] == "finished":
            arrays[cell] = parts
    with (
        write_atomically(folder / "results.csv") as path,
        path.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        for row in rows.values():
            writer.writerow({name: as_text(row.get(name)) for name in COLUMNS})
    flat = {
        f"{cell.key}/{name}": values
        for cell, parts in arrays.items()
        for name, values in parts.items()
    }
    with (
        write_atomically(folder / ARRAYS) as path,
        path.open("wb") as file,
    ):
        np.savez_compressed(file, **flat)
    statuses = [row["status"] for row in rows.values()]
    manifest = {
        "suite": suite.name,
        "cells": len(suite.cells),
        "finished": statuses.count("finished"),
        "failed": statuses.count("failed"),
        "not run": len(suite.cells) - len(rows),
        "written": time.strftime("%Y-%m-%dT%H:%M:%S"),
        "machine": describe_machine(threads=1),
        "system": platform.platform(),
        "packages": list(PACKAGES),
        "git commit of this table": git_commit(),
        "git commits of the cells": sorted(
            {row["git_commit"] for row in rows.values() if "git_commit" in row}
        ),
        CHECKSUM: _checksum(folder / "results.csv"),
    }
    with write_atomically(folder / "manifest.json") as path:
        path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return Table(rows, arrays)


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
    return Table(rows, arrays)


# Checks of what was read -------------------------------------------------------------


def _read_rows(suite: Suite, path: Path) -> dict[Cell, dict[str, Any]]:
    known = set(suite.cells)
    rows: dict[Cell, dict[str, Any]] = {}
    numbers: dict[Cell, int] = {}
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
                    raise ValueError(f"{cell} is in row {numbers[cell]} already")
            rows[cell], numbers[cell] = row, number
    return rows


def _read_arrays(
    suite: Suite, rows: dict[Cell, dict[str, Any]], path: Path
) -> dict[Cell, dict[str, np.ndarray]]:
    arrays: dict[Cell, dict[str, np.ndarray]] = {cell: {} for cell in rows}
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


def _check_manifest(
    rows: dict[Cell, dict[str, Any]], path: Path, manifest: Path
) -> None:
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


# Rows --------------------------------------------------------------------------------


def group_by(cells: Iterable[Cell], *names: str) -> dict[tuple[Any, ...], list[Cell]]:
    """Group cells by some of their fields, in order of appearance."""
    groups: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        groups.setdefault(tuple(getattr(cell, name) for name in names), []).append(cell)
    return groups


def mean_and_spread(values: list[float]) -> tuple[float, float]:
    """Return the mean and, of several values, the standard deviation.

    One -inf makes the mean -inf, without a spread.
    """
    mean = sum(values) / len(values)
    if len(values) < 2 or not math.isfinite(mean):
        return mean, math.nan
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return mean, math.sqrt(variance)
