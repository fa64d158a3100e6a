"""Runs cells, in parallel, and keeps what is finished."""

import contextlib
import functools
import itertools
import subprocess
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from sbi.utils.metrics import c2st
from tqdm.auto import tqdm

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.machine import forget_peak, peak_memory
from benchmarks.scoring import Failure, Score, scores
from benchmarks.store import Result, Results
from sbi_rope.metrics import draw_samples

__all__ = ["Workplace", "run_cells"]

PACKAGES = ("torch", "sbi", "POT", "numpy")
# Samples behind the comparison with a posterior in closed form.
C2ST_SAMPLES = 500
# Posterior samples of the first observation that are kept for a picture.
KEPT_SAMPLES = 300


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Where a run reads and writes, and what it runs on.

    Attributes:
        folder: A folder for each suite, and for what cells share.
        sources: Where recorded data are.
        device: Where networks are trained.
    """

    folder: Path
    sources: Sources = field(default_factory=Sources)
    device: str = "cpu"

    def case(self, cell: Cell) -> Case:
        """Return the data of a cell."""
        return Case.of(cell, self.sources, self.folder / "cache", self.device)


def run_cells(
    cells: Sequence[Cell],
    results: Results,
    workplace: Workplace,
    *,
    jobs: int = 1,
    backend: str = "loky",
    again: bool = False,
    retry: bool = False,
) -> dict[str, int]:
    """Run the cells that have no result yet, and count how they ended.

    Args:
        cells: What to run.
        results: Where results are kept, each as soon as it is there.
        workplace: What cells are run on.
        jobs: Cells, or those that share a training, computed at a time.
        backend: Name of a backend of joblib. Each job needs a process of its own.
        again: Whether to compute finished cells anew.
        retry: Whether to compute failed cells anew.

    Returns:
        The number of cells that were ``"kept"``, ``"finished"`` and ``"failed"``.
    """
    results.take_over(cells)
    known = {} if again else results.rows["status"].to_dict()
    kept = {
        cell for cell, status in known.items() if not (retry and status == "failed")
    }
    groups = _grouped([cell for cell in cells if cell not in kept])
    waiting = sum(map(len, groups))
    counts = {"kept": len(cells) - waiting, "finished": 0, "failed": 0}
    # What methods share is made first, so that no two jobs make it at the same time.
    shared = {group[0].group[:5]: group[0] for group in groups}
    with (
        joblib.parallel_config(backend=backend, n_jobs=jobs),
        tqdm(total=waiting, desc="Cells", smoothing=0.1) as bar,
    ):
        run = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        for _ in run(
            joblib.delayed(prepare)(cell, workplace) for cell in shared.values()
        ):
            pass
        for found in run(
            joblib.delayed(run_group)(group, workplace) for group in groups
        ):
            results.add(found)
            for result in found:
                counts[result.row["status"]] += 1
            bar.update(len(found))
    return counts


def _grouped(cells: Sequence[Cell]) -> list[list[Cell]]:
    ordered = sorted(cells, key=lambda cell: repr(cell.group))
    return [
        list(group) for _, group in itertools.groupby(ordered, key=lambda c: c.group)
    ]


def prepare(cell: Cell, workplace: Workplace) -> None:
    """Draw the simulations and train the NPE of a cell, if they are not there yet."""
    _use_one_thread()
    # An error comes again when the cell is run.
    with contextlib.suppress(Exception):
        _ = workplace.case(cell).npe


def run_group(cells: Sequence[Cell], workplace: Workplace) -> list[Result]:
    """Run cells that share all but gamma and tau."""
    _use_one_thread()
    _git_commit()  # now, not when a cell is finished hours later
    results: dict[Cell, Result] = {}
    try:
        case = workplace.case(cells[0])
        forget_peak()
        for score in scores(case, cells):
            if isinstance(score, Failure):
                results[score.cell] = _failed(score.cell, score.error)
            else:
                results[score.cell] = Result(_row(case, score), _arrays(score))
            forget_peak()
    except Exception as error:
        traceback.print_exc()
        for cell in cells:
            results.setdefault(cell, _failed(cell, error))
    return [*results.values()]


def _failed(cell: Cell, error: Exception) -> Result:
    text = f"{type(error).__name__}: {error}"
    return Result({**asdict(cell), "status": "failed", "error": text}, {})


def _use_one_thread() -> None:
    # Training depends on the number of threads, and a table must not.
    torch.set_num_threads(1)


def _row(case: Case, score: Score) -> dict[str, Any]:
    evaluation = score.evaluation
    names, log_prob = case.task.parameter_names, evaluation.log_prob
    acauc = [one.mean for one in evaluation.acauc_of_parameters]
    per_parameter = zip(names, acauc, strict=True)
    root = len(log_prob) ** 0.5
    return {
        **asdict(score.cell),
        "status": "finished",
        **evaluation.as_row(),
        "lpp_median": float(log_prob.quantile(0.5, interpolation="nearest")),
        "neg_inf_fraction": float(log_prob.isneginf().double().mean()),
        "lpp_standard_error": float(log_prob.std()) / root,
        "acauc_standard_error": float(evaluation.levels.mean(dim=1).std()) / root,
        "acauc_per_parameter": "; ".join(f"{n}={v:.4f}" for n, v in per_parameter),
        "c2st": _c2st(case, score),
        "converged": score.converged,
        "n_test": len(score.test_set[0]),
        "stand_in": case.task.stand_in,
        "seconds_npe": round(case.npe_seconds, 1) if score.shares_npe else 0.0,
        "seconds_train": round(score.train_seconds, 2),
        "seconds_couple": round(score.couple_seconds, 2),
        "seconds_test": round(score.test_seconds, 2),
        "num_simulations": score.num_simulations,
        "peak_memory_mb": peak_memory(),
        "device": case.device,
        "versions": "; ".join(f"{name} {version(name)}" for name in PACKAGES),
        "git_commit": _git_commit(),
        "finished_at": time.strftime("%Y-%m-%dT%H:%M:%S"),
    }


def _c2st(case: Case, score: Score) -> float | None:
    """Return the mean C2ST to the true posterior of the task, if that is known."""
    known = getattr(case.task, "has_true_posterior", False)
    if not known or score.cell.method == "SBI":
        return None
    values = []
    for i in range(min(case.settings.c2st_observations, len(score.test_set[1]))):
        x = score.test_set[1][i : i + 1]
        with torch.random.fork_rng():
            torch.manual_seed(case.seed)
            truth = case.task.get_true_posterior(x).sample((C2ST_SAMPLES,))
            samples = draw_samples(score.posterior, x, num_samples=C2ST_SAMPLES)
        values.append(
            float(c2st(truth.reshape(C2ST_SAMPLES, -1), samples[:, 0], seed=case.seed))
        )
    return sum(values) / len(values)


def _arrays(score: Score) -> dict[str, np.ndarray]:
    """Return what figures and paired tests need besides the row."""
    evaluation = score.evaluation
    x = score.test_set[1][:1]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        samples = draw_samples(score.posterior, x, num_samples=KEPT_SAMPLES)
    return {
        "log_probs": _shortened(evaluation.log_prob.cpu().numpy()),
        "coverage": evaluation.coverage.mean(dim=1).cpu().numpy().astype(np.float32),
        **score.arrays,
        "samples": samples[:, 0].cpu().numpy().astype(np.float32),
        "theta": score.test_set[0][0].cpu().numpy().astype(np.float32),
    }


def _shortened(values: np.ndarray) -> np.ndarray:
    """Return values in single precision, unless one would become infinite."""
    with np.errstate(over="ignore"):
        short = values.astype(np.float32)
    return short if np.array_equal(np.isinf(short), np.isinf(values)) else values


@functools.cache
def _git_commit() -> str:
    """Return the commit the code is at, with a plus if it was changed since."""
    folder = Path(__file__).parent

    def git(*args: str) -> str:
        result = subprocess.run(
            ("git", "-C", str(folder), *args),
            capture_output=True,
            text=True,
            check=False,
        )
        return result.stdout.strip()

    commit = git("rev-parse", "--short", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no")
    return (commit or "unknown") + ("+" if changed else "")
