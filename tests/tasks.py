"""Tasks as the contract tests make them, and ways to compare their sets."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope.tasks import Task, get_task

__all__ = [
    "SUBTLE",
    "at_most",
    "draw",
    "largest_z",
    "make",
    "root_fixture",
    "rows_of",
    "same_rows",
]

# Fixtures that give the folder of a task's recorded data; other tasks are synthetic.
ROOT_FIXTURES = {"light_tunnel_sensors": "chamber_root"}
# Small images are quick to write, read and compare.
# Without 8-bit levels, no two of them are equal. Recorded sets have their own tests.
OPTIONS: dict[str, dict[str, Any]] = {
    "light_tunnel": {"image_size": 64, "stand_in": True, "dequantise": True},
    "wind_tunnel": {"stand_in": True},
}
# Tasks with few stored observations, and how many these tests may take at once.
LARGEST = {"hemodynamics": 60}
# Tasks whose misspecification takes more than means and variances of x to see.
SUBTLE = {"hemodynamics"}


def make(name: str, **options: Any) -> Task:
    return get_task(name, **OPTIONS.get(name, {}), **options)


def root_fixture(name: str) -> str | None:
    return ROOT_FIXTURES.get(name)


def at_most(n: int, name: str) -> int:
    return min(n, LARGEST.get(name, n))


def draw(
    task: Task, part: str, n: object, *, seed: object = 0
) -> tuple[Tensor, Tensor]:
    get = task.get_calibration_set if part == "calibration" else task.get_test_set
    return get(n, seed=seed)  # type: ignore[arg-type]


def rows_of(x: Tensor) -> list[bytes]:
    return [row.numpy().tobytes() for row in x.flatten(1)]


def same_rows(a: Tensor, b: Tensor) -> int:
    rows = set(rows_of(a))
    return sum(row in rows for row in rows_of(b))


def coarse(x: Tensor) -> Tensor:
    """Entries of x; of images, those of a coarser one."""
    if x.ndim == 4:
        x = torch.nn.functional.adaptive_avg_pool2d(x, 4)
    return x.flatten(1).double()


def largest_z(a: Tensor, b: Tensor) -> float:
    """Largest difference between means and variances of entries, in standard errors."""
    a, b = coarse(a), coarse(b)
    centre = (a.mean(dim=0) + b.mean(dim=0)) / 2
    a, b = (torch.cat([x, (x - centre) ** 2], dim=1) for x in (a, b))
    error = (a.var(dim=0) / len(a) + b.var(dim=0) / len(b)).sqrt()
    difference = (a.mean(dim=0) - b.mean(dim=0)).abs()
    return float((difference / error)[difference > 0].max())
