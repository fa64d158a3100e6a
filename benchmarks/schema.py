"""The columns of a table of results: what an entry may be, in memory and as text."""

import functools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.cells import Cell
from sbi_rope._means import standard_error_of_mean
from sbi_rope.tasks import Task, get_task

__all__ = [
    "CELL_COLUMNS",
    "COLUMNS",
    "TEXT_COLUMNS",
    "WHERE",
    "as_text",
    "check_row",
    "check_scores",
    "from_text",
]

STATUSES = ("finished", "failed")
# Cells with the same of these are of one section.
WHERE = ["task", "variant", "options"]
# Log-probabilities are kept in single precision, and sums of them depend on the order.
RELATIVE, ABSOLUTE = 1e-6, 1e-6
# `acauc_per_parameter` has four digits.
ROUNDED = 1e-4
# Arrays of every finished cell, and their dimensions.
NEEDED = {"log_probs": 1, "coverage": 1, "samples": 2, "theta": 1}


class Kind(NamedTuple):
    """What an entry may be.

    Attributes:
        what: In words, for messages.
        type: Its type; a whole number counts as a float.
        low: The least it may be.
        high: The most it may be.
        optional: Whether it may be empty.
        nan: Whether it may be nan.
    """

    what: str
    type: type
    low: float = -math.inf
    high: float = math.inf
    optional: bool = False
    nan: bool = False

    def holds(self, value: Any) -> bool:
        """Whether a value is of this kind."""
        # True is an int in Python, but no number here.
        if self.type in (str, bool) or isinstance(value, str | bool):
            return type(value) is self.type
        if not isinstance(value, int | (float if self.type is float else int)):
            return False
        return self.nan if math.isnan(value) else self.low <= value <= self.high

    def read(self, text: str) -> Any:
        """Return the value of a text; raise ``ValueError`` if it is none."""
        if self.type is not bool:
            return self.type(text)
        # Not `text == "True"`: a spreadsheet writes TRUE, which would become False.
        return {"True": True, "False": False}[text]


TEXT = Kind("text", str)
FILLED = Kind("text that is not empty", str)
FLAG = Kind("True or False", bool)
SCORE = Kind("a number, or -inf", float)
ERROR = Kind("a number that is not negative, or nan", float, 0, nan=True)
SHARE = Kind("a number from 0 to 1", float, 0, 1)
SECONDS = Kind("a number of seconds", float, 0)
COUNT = Kind("a whole number from 0 on", int, 0)

OF_CELLS = {
    "task": FILLED,
    "variant": TEXT,
    "options": FILLED,
    "preset": FILLED,
    "method": FILLED,
    "n_calibration": COUNT,
    "gamma": Kind("a positive number, or nothing", float, 0, optional=True),
    "tau": Kind("a number from 0 to 1, or nothing", float, 0, 1, optional=True),
    "cost_scale": TEXT,
    "repetition": COUNT,
}
# Of a cell that is finished.
OF_RESULTS = {
    "lpp": SCORE,
    "lpp_z": SCORE,
    "lpp_median": SCORE,
    "lpp_standard_error": ERROR,
    "neg_inf_fraction": SHARE,
    "acauc": Kind("a number from -0.5 to 0.5", float, -0.5, 0.5),
    "acauc_standard_error": ERROR,
    "acauc_per_parameter": FILLED,
    "expected_coverage_error": SHARE,
    "c2st": Kind("a number from 0 to 1, or nothing", float, 0, 1, optional=True),
    "converged": FLAG,
    "n_test": Kind("a whole number from 1 on", int, 1),
    "stand_in": FLAG,
    "seconds_npe": SECONDS,
    "seconds_train": SECONDS,
    "seconds_couple": SECONDS,
    "seconds_test": SECONDS,
    "num_simulations": COUNT,
    "peak_memory_mb": ERROR,
    "device": TEXT,
    "versions": TEXT,
    "git_commit": TEXT,
    "finished_at": TEXT,
}
CELL_COLUMNS = tuple(field.name for field in fields(Cell))
COLUMNS = ("suite", *CELL_COLUMNS, "status", *OF_RESULTS, "error")
KINDS = {"suite": FILLED, **OF_CELLS, "status": FILLED, **OF_RESULTS, "error": TEXT}
TEXT_COLUMNS = tuple(name for name, kind in KINDS.items() if kind.type is str)


def check_row(row: Mapping[str, Any], cell: Cell | None = None) -> None:
    """Check the entries of a row.

    Args:
        row: Values by column.
        cell: The cell that it has to belong to.

    Raises:
        ValueError: If one is not what its column holds. It names the column.
    """
    _check(row, OF_CELLS)
    expected = {} if cell is None else asdict(cell)
    for name, value in expected.items():
        if row[name] != value:
            raise ValueError(f"column {name}: expected {value!r}; got {row[name]!r}")
    status = row.get("status")
    if status not in STATUSES:
        raise ValueError(
            f"column status: expected {' or '.join(STATUSES)}; got {status!r}"
        )
    _check(row, OF_RESULTS if status == "finished" else {"error": FILLED})


def _check(row: Mapping[str, Any], kinds: Mapping[str, Kind]) -> None:
    for name, kind in kinds.items():
        value = row.get(name)
        if value is None and kind.optional and name in row:
            continue
        if not kind.holds(value) or (kind is FILLED and not value):
            raise ValueError(f"column {name}: expected {kind.what}; got {value!r}")


def as_text(value: Any) -> str:
    """Return an entry as the text of a CSV file."""
    if value is None:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def from_text(name: str, text: str) -> Any:
    """Return the entry of a column from the text of a CSV file; None if it is empty.

    Raises:
        ValueError: If it cannot be read. It names the column.
    """
    kind = KINDS[name]
    if text == "" and kind.type is not str:
        return None
    try:
        return kind.read(text)
    except (ValueError, KeyError) as error:
        raise ValueError(
            f"column {name}: expected {kind.what}; got {text!r}"
        ) from error


def check_scores(
    row: Mapping[str, Any], cell: Cell, arrays: Mapping[str, np.ndarray]
) -> None:
    """Check the scores of a finished cell against its arrays, where these tell them.

    What training cost, and what is not a mean over observations, they do not tell.

    Raises:
        ValueError: If a score is not that of the arrays. It names the column.
    """
    for name, dimensions in NEEDED.items():
        values = arrays.get(name, np.array("nothing"))
        if values.ndim != dimensions or values.dtype.kind != "f" or not values.size:
            raise ValueError(
                f"array {name}: expected numbers in {dimensions} dimension(s); got "
                f"{values.dtype} of shape {values.shape}"
            )
    task = _task(cell.task, cell.variant, cell.options)
    for name, low, high in _bounds(row, task, arrays):
        if not low <= row[name] <= high and not math.isnan(low):
            expected = f"{low:.6g}" if f"{low:.6g}" == f"{high:.6g}" else ""
            expected = expected or f"{low:.6g} to {high:.6g}"
            raise ValueError(
                f"column {name}: expected {expected}, which follows from the arrays; "
                f"got {row[name]!r}"
            )
    names, _ = _per_parameter(row)
    if names != tuple(task.parameter_names):
        raise ValueError(
            "column acauc_per_parameter: expected the parameters "
            f"{', '.join(task.parameter_names)}; got {row['acauc_per_parameter']!r}"
        )


def _bounds(
    row: Mapping[str, Any], task: Task, arrays: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, float, float]]:
    """Give columns, with the least and the largest value that fits the arrays."""
    log_probs = arrays["log_probs"].astype(float)
    yield _near("n_test", len(log_probs))
    yield _near("stand_in", task.stand_in)
    lost = np.isneginf(log_probs)
    size = float(np.abs(log_probs[~lost]).sum()) / len(log_probs)
    rounding = ABSOLUTE + RELATIVE * size
    yield _near("neg_inf_fraction", float(lost.mean()), ABSOLUTE)
    mean = float(log_probs.mean())
    yield _near("lpp", mean, rounding)
    unit = _unit(task)
    yield _near("lpp_z", mean + unit, rounding)
    values = torch.from_numpy(log_probs)
    median = float(values.quantile(0.5, interpolation="nearest"))
    yield _near("lpp_median", median, rounding)
    yield _near("lpp_standard_error", standard_error_of_mean(values), rounding)

    # The curve rises with the level: the area under it is between these two sums.
    coverage = arrays["coverage"].astype(float)
    area = float(coverage.sum()) / (len(coverage) + 1)
    step = 1 / (len(coverage) + 1)
    yield "acauc", 0.5 - area - step - ABSOLUTE, 0.5 - area + ABSOLUTE
    _, values = _per_parameter(row)
    average = sum(values) / len(values)
    yield "acauc", average - ROUNDED, average + ROUNDED
    # Errors of several parameters cancel in the average of their curves.
    levels = np.arange(1, len(coverage) + 1) * step
    distance = float(np.abs(coverage - levels).mean())
    highest = distance + ABSOLUTE if len(values) == 1 else 1.0
    yield "expected_coverage_error", distance - ABSOLUTE, highest


def _near(name: str, value: float, tolerance: float = 0.0) -> tuple[str, float, float]:
    if not math.isfinite(value):
        return name, value, value
    return name, value - tolerance, value + tolerance


def _per_parameter(row: Mapping[str, Any]) -> tuple[tuple[str, ...], list[float]]:
    text = row["acauc_per_parameter"]
    try:
        parts = [part.split("=") for part in text.split("; ")]
        return tuple(name for name, _ in parts), [float(value) for _, value in parts]
    except ValueError as error:
        raise ValueError(
            "column acauc_per_parameter: expected entries like red=-0.0030; "
            f"got {text!r}"
        ) from error


@functools.cache
def _unit(task: Task) -> float:
    return float(task.prior_std.double().log().sum())


@functools.cache
def _task(name: str, variant: str, options: str) -> Task:
    # Neither scales nor names need recorded data.
    return get_task(name, variant=variant or None, **json.loads(options))
