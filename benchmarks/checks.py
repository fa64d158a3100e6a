"""Whether scores are those of the arrays that lie beside them."""

import functools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.cells import Cell
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics.calibration import standard_error_of_mean
from sbi_rope.tasks import Task, get_task

__all__ = ["check_scores", "read_mapping"]

# Log-probabilities are kept in single precision, and sums of them depend on the order.
RELATIVE, ABSOLUTE = 1e-6, 1e-6
# `acauc_per_parameter` has four digits.
ROUNDED = 1e-4
# Arrays of every finished cell, and their dimensions.
NEEDED = {"log_probs": 1, "coverage": 1, "samples": 2, "theta": 1}


def read_mapping(path: Path) -> dict[str, Any]:
    """Read names and values from a JSON file.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it holds something else, or is damaged.
    """
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise InvalidInputError(
            f"expected names and values; got {type(content).__name__}"
        )
    return content


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
    yield _equal("n_test", len(log_probs))
    yield _equal("stand_in", task.stand_in)
    lost = np.isneginf(log_probs)
    size = float(np.abs(log_probs[~lost]).sum()) / len(log_probs)
    rounding = ABSOLUTE + RELATIVE * size
    yield _near("neg_inf_fraction", float(lost.mean()), ABSOLUTE)
    mean = float(log_probs.mean())
    yield _near("lpp", mean, rounding)
    unit = float(task.prior_std.double().log().sum())
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


def _equal(name: str, value: float) -> tuple[str, float, float]:
    return name, value, value


def _near(name: str, value: float, tolerance: float) -> tuple[str, float, float]:
    if not math.isfinite(value):
        return _equal(name, value)
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
def _task(name: str, variant: str, options: str) -> Task:
    # Neither scales nor names need recorded data.
    return get_task(name, variant=variant or None, **json.loads(options))
