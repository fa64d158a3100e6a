"""Made-up results of the benchmark, and damage to the files they are kept in."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.cells import Cell, Suite
from benchmarks.store import Results
from sbi_rope.metrics import LPPScore
from sbi_rope.tasks import get_task

__all__ = [
    "FAILED",
    "SUITE",
    "Result",
    "empty",
    "fill_with_garbage",
    "remove",
    "result_of",
    "truncate",
    "write_results",
]

SUITE = """
title = "Tiny"
question = "Nothing."
preset = "smoke"
repetitions = 2

[[cells]]
tasks = ["linear_gaussian"]
methods = ["prior", "MLP", "OT-only", "RoPE"]
n_calibration = [10, 50]
gammas = { simulated = [0.1, 0.2], none = [0.5] }
taus = [1.0, 0.9]
options = { dim = [2, 3] }
"""
Result = tuple[dict[str, Any], dict[str, np.ndarray]]


def result_of(cell: Cell, log_probs: list[float]) -> Result:
    """Make up a finished cell, with densities in standard deviations of the prior."""
    options = json.loads(cell.options)
    task = get_task(cell.task, variant=cell.variant or None, **options)
    unit = float(task.prior_std.double().log().sum())
    values = np.array(log_probs, dtype=np.float32) - np.float32(unit)
    score = LPPScore(log_probs=torch.from_numpy(values).double())
    row = {
        "status": "finished",
        "lpp": score.mean,
        "lpp_z": score.mean + unit,
        "lpp_median": score.median,
        "lpp_standard_error": score.standard_error,
        "neg_inf_fraction": score.neg_inf_fraction,
        "acauc": 0.01,
        "acauc_standard_error": 0.01,
        "acauc_per_parameter": "; ".join(f"{n}=0.0100" for n in task.parameter_names),
        "expected_coverage_error": 0.02,
        "c2st": None,
        "converged": True,
        "n_test": len(log_probs),
        "stand_in": False,
        "seconds_npe": 0.0,
        "seconds_train": 0.0,
        "seconds_couple": 0.0,
        "seconds_test": 0.0,
        "num_simulations": 100,
        "peak_memory_mb": 600.0,
        "device": "cpu",
        "versions": "torch 2",
        "git_commit": "abc",
        "finished_at": "2026-01-01T00:00:00",
    }
    generator = np.random.default_rng(0)
    arrays = {
        "log_probs": values,
        "coverage": (np.arange(1, 100) / 100 - 0.015).clip(0).astype(np.float32),
        "samples": generator.normal(size=(50, task.theta_dim)).astype(np.float32),
        "theta": np.zeros(task.theta_dim, dtype=np.float32),
    }
    return row, arrays


FAILED = {"status": "failed", "error": "ValueError: no"}


def write_results(suite: Suite, folder: Path) -> Results:
    """All cells but those of the second repetition; the prior has one -inf."""
    results = Results(folder)
    for cell in suite.cells:
        if cell.repetition:
            continue
        if cell.method == "MLP":
            results.write(cell, FAILED, {})
            continue
        if cell.method == "prior":
            log_probs = [-math.inf, -1.0, -1.0, -1.0]
        else:
            value = {"OT-only": -2.0, "RoPE": -1.0}[cell.method]
            log_probs = [value + 0.1 * i for i in (-1, 0, 0, 1)]
        results.write(cell, *result_of(cell, log_probs))
    return results


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def fill_with_garbage(path: Path) -> None:
    path.write_bytes(b"\x80\x02garbage" * 20)


def remove(path: Path) -> None:
    path.unlink()
