"""The committed form of results: a tidy CSV, arrays beside it, and a manifest."""

import csv
import json
import math
import platform
import time
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cells import Cell, Suite
from benchmarks.machine import describe_machine
from benchmarks.runner import PACKAGES, git_commit
from benchmarks.store import Results, write_atomically

__all__ = ["Table", "read_table", "write_table"]

CELL_COLUMNS = tuple(field.name for field in fields(Cell))
COLUMNS = (
    "suite",
    *CELL_COLUMNS,
    "status",
    "lpp",
    "lpp_z",
    "lpp_median",
    "lpp_standard_error",
    "neg_inf_fraction",
    "acauc",
    "acauc_standard_error",
    "acauc_per_parameter",
    "expected_coverage_error",
    "c2st",
    "converged",
    "n_test",
    "stand_in",
    "seconds_npe",
    "seconds_train",
    "seconds_couple",
    "seconds_test",
    "num_simulations",
    "peak_memory_mb",
    "device",
    "versions",
    "git_commit",
    "finished_at",
    "error",
)
INTEGERS = ("n_calibration", "repetition", "n_test", "num_simulations")


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
        row = results.read(cell)
        if row is None:
            continue
        rows[cell] = {"suite": suite.name, **row}
        if row["status"] == "finished":
            arrays[cell] = results.read_arrays(cell)
    with (
        write_atomically(folder / "results.csv") as path,
        path.open("w", newline="") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        for row in rows.values():
            writer.writerow({name: _as_text(row.get(name)) for name in COLUMNS})
    flat = {
        f"{cell.key}/{name}": values
        for cell, parts in arrays.items()
        for name, values in parts.items()
    }
    with (
        write_atomically(folder / "arrays.npz") as path,
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
    }
    with write_atomically(folder / "manifest.json") as path:
        path.write_text(json.dumps(manifest, indent=1) + "\n")
    return Table(rows, arrays)


def read_table(folder: Path) -> Table:
    """Read what :func:`write_table` wrote; without arrays if they are not there."""
    rows = {}
    with (folder / "results.csv").open(newline="") as file:
        for line in csv.DictReader(file):
            row = {name: _from_text(name, text) for name, text in line.items()}
            rows[Cell(**{name: row[name] for name in CELL_COLUMNS})] = row
    arrays: dict[Cell, dict[str, np.ndarray]] = {cell: {} for cell in rows}
    path = folder / "arrays.npz"
    if path.exists():
        by_key = {cell.key: cell for cell in rows}
        with np.load(path) as archive:
            for name in archive.files:
                key, part = name.split("/")
                if key in by_key:
                    arrays[by_key[key]][part] = archive[name]
    return Table(rows, arrays)


def _as_text(value: Any) -> str:
    if value is None:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


TEXTS = {
    *("suite", "task", "variant", "options", "preset", "method", "cost_scale"),
    *("status", "acauc_per_parameter", "device", "versions", "git_commit"),
    *("finished_at", "error"),
}
FLAGS = ("converged", "stand_in")


def _from_text(name: str, text: str) -> Any:
    if name in TEXTS:
        return text
    if text == "":
        return None
    if name in FLAGS:
        return text == "True"
    return int(text) if name in INTEGERS else float(text)


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
