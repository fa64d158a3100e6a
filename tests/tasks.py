"""Tasks as the tests make them, and ways to compare their sets and their refusals."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope.tasks import Task, get_task
from tests.conftest import SHARED_DATA, TEST_DATA

# Their parameters were measured, and none was set. The repository has no data of them.
MEASURED = ("near_infrared", "ocean_colour")
# Folders with the recorded data of tasks; the other tasks are drawn here.
ROOTS: dict[str, Path] = {
    "light_tunnel_sensors": TEST_DATA / "causal_chamber",
} | dict.fromkeys(MEASURED, SHARED_DATA / "real")
# Small images are quick to write, read and compare.
# Without 8-bit levels, no two of them are equal. Recorded sets have their own tests.
OPTIONS: dict[str, dict[str, Any]] = {
    "light_tunnel": {"image_size": 64, "stand_in": True, "dequantise": True},
    "wind_tunnel": {"stand_in": True},
}
# Tasks whose misspecification takes more than means and variances of x to see.
SUBTLE = {"hemodynamics"}


def make(name: str, **options: Any) -> Task:
    """Return a task that has its data."""
    return get_task(name, root=ROOTS.get(name), **OPTIONS.get(name, {}), **options)


def skip_without_data(task: Task) -> None:
    if task.name in MEASURED and not task.has_data:
        pytest.skip(f"the data of {task.name} are not on this machine")


def as_many(n: int, task: Task, part: str, *, seed: int = 0) -> int:
    """Return ``n``, or the number of recorded pairs where there are fewer."""
    skip_without_data(task)
    recorded = task.num_recorded(part, seed=seed)  # type: ignore[arg-type]
    return n if recorded is None else min(n, recorded)


def draw(
    task: Task, part: str, n: object, *, seed: object = 0
) -> tuple[Tensor, Tensor]:
    skip_without_data(task)
    get = task.get_calibration_set if part == "calibration" else task.get_test_set
    return get(n, seed=seed)  # type: ignore[arg-type]


def all_recorded(task: Task, num_rows: int) -> tuple[Tensor, Tensor]:
    """Return the pairs of both parts of a recording with so many rows."""
    third = num_rows // 3
    parts = (task.get_calibration_set(third), task.get_test_set(num_rows - third))
    theta, x = zip(*parts, strict=True)
    return torch.cat(theta), torch.cat(x)


def rows_of(x: Tensor) -> list[bytes]:
    return [row.numpy().tobytes() for row in x.flatten(1)]


def same_rows(a: Tensor, b: Tensor) -> int:
    rows = set(rows_of(a))
    return sum(row in rows for row in rows_of(b))


def largest_z(a: Tensor, b: Tensor, *, paired: bool = False) -> float:
    """Largest difference between means and variances of entries, in standard errors.

    Paired rows belong to the same parameters, whose scatter is then left out. Images
    are made coarser first.
    """
    if a.ndim == 4:
        a, b = (torch.nn.functional.adaptive_avg_pool2d(x, 4) for x in (a, b))
    a, b = a.flatten(1).double(), b.flatten(1).double()
    centre = (a.mean(dim=0) + b.mean(dim=0)) / 2
    a, b = (torch.cat([x, (x - centre) ** 2], dim=1) for x in (a, b))
    error = (a.var(dim=0) / len(a) + b.var(dim=0) / len(b)).sqrt()
    if paired:
        error = ((a - b).var(dim=0) / len(a)).sqrt()
    difference = (a.mean(dim=0) - b.mean(dim=0)).abs()
    return float((difference / error)[difference > 0].max())


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a table of a recording, in a folder that need not be there yet."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
