"""Runs cells, in parallel, and keeps what is finished."""

import functools
import itertools
import subprocess
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from sbi.utils.metrics import c2st
from tqdm.auto import tqdm

from benchmarks.cases import Case
from benchmarks.cells import Cell
from benchmarks.machine import forget_peak, peak_memory
from benchmarks.methods import METHODS
from benchmarks.scoring import Failure, Score, scores
from benchmarks.store import Workplace
from sbi_rope.metrics import draw_samples

__all__ = ["PACKAGES", "git_commit", "run_cells"]

PACKAGES = ("torch", "sbi", "POT", "numpy")
# Samples behind the comparison with a posterior in closed form.
C2ST_SAMPLES = 500
# Posterior samples of the first observation that are kept for a picture.
KEPT_SAMPLES = 300


def run_cells(
    cells: Sequence[Cell],
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
        workplace: Where results are kept.
        jobs: Cells, or sweeps over gamma and tau, computed at a time.
        backend: Name of a backend of joblib.
        again: Whether to compute finished cells anew.
        retry: Whether to compute failed cells anew.

    Returns:
        The number of cells that were ``"kept"``, ``"finished"`` and ``"failed"``.

    Raises:
        InvalidInputError: If another run is at work in the folder.
        NotWritableError: If nothing can be written to it.
        SystemExit: If it holds results of other data, devices or settings.
    """
    if backend == "threading":
        raise SystemExit("Threads share random numbers; use loky or another backend.")
    with workplace.claimed():
        workplace.results.set_damaged_aside(cells)
        waiting = {
            cell
            for cell in cells
            if again or _is_missing(workplace.results.read(cell), retry=retry)
        }
        counts = {"kept": len(cells) - len(waiting), "finished": 0, "failed": 0}
        for status in _run(cells, waiting, workplace, jobs=jobs, backend=backend):
            counts[status] += 1
    return counts


def _run(
    cells: Sequence[Cell],
    waiting: set[Cell],
    workplace: Workplace,
    *,
    jobs: int,
    backend: str,
) -> list[str]:
    """Run those that wait, and return how each ended."""
    # Whole groups, also where only some of their cells are missing: a sweep starts each
    # coupling from its neighbour, and a resumed run must pass by the same ones.
    groups = [group for group in _grouped(cells) if waiting & set(group)]
    # What methods share is made first, so that no two jobs make it at the same time.
    shared = {group[0].group[:5]: group[0] for group in groups}
    _parallel(jobs, backend, [(prepare, cell, workplace) for cell in shared.values()])
    calls = [
        (run_group, group, [cell for cell in group if cell in waiting], workplace)
        for group in groups
    ]
    with tqdm(total=len(waiting), desc="Cells", smoothing=0.1) as bar:
        ended = _parallel(jobs, backend, calls, bar=bar)
    return [status for statuses in ended for status in statuses]


def _parallel(
    jobs: int, backend: str, calls: list[tuple[Any, ...]], bar: Any = None
) -> list[Any]:
    """Return the results of calls, in the order in which they end.

    Args:
        jobs: Calls at a time.
        backend: Name of a backend of joblib.
        calls: Functions, each with its arguments.
        bar: A progress bar that counts what the results hold.
    """
    results = []
    # The way that knows external backends, dask's among them.
    with joblib.parallel_config(backend=backend, n_jobs=jobs):
        run = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        for result in run(joblib.delayed(call[0])(*call[1:]) for call in calls):
            results.append(result)
            if bar is not None:
                bar.update(len(result))
    return results


def _is_missing(row: dict[str, Any] | None, *, retry: bool) -> bool:
    return row is None or (retry and row["status"] == "failed")


def _grouped(cells: Sequence[Cell]) -> list[list[Cell]]:
    ordered = sorted(cells, key=lambda cell: repr(cell.group))
    return [
        list(group) for _, group in itertools.groupby(ordered, key=lambda c: c.group)
    ]


def prepare(cell: Cell, workplace: Workplace) -> None:
    """Draw the simulations and train the NPE of a cell, if they are not there yet."""
    _use_one_thread()
    try:
        case = Case.of(cell, workplace.sources, workplace.cache, workplace.device)
        _ = case.npe
    except Exception:
        return


def run_group(group: list[Cell], cells: list[Cell], workplace: Workplace) -> list[str]:
    """Run cells that share all but gamma and tau; write each when it is finished.

    Args:
        group: All of them, for the way the couplings of a sweep follow each other.
        cells: Those to run.
        workplace: Where results are kept.
    """
    _use_one_thread()
    git_commit()  # now, not when a cell is finished hours later
    statuses = []
    left = list(cells)

    def fail(cell: Cell, error: Exception) -> None:
        row = {
            **asdict(cell),
            "status": "failed",
            "error": f"{type(error).__name__}: {error}",
            "traceback": "".join(traceback.format_exception(error)),
        }
        workplace.results.write(cell, row, {})
        statuses.append("failed")

    try:
        case = Case.of(cells[0], workplace.sources, workplace.cache, workplace.device)
        _check_data(case)
        forget_peak()
        for score in scores(case, cells, group):
            if isinstance(score, Failure):
                fail(score.cell, score.error)
            else:
                workplace.results.write(score.cell, _row(case, score), _arrays(score))
                statuses.append("finished")
            left.remove(score.cell)
            forget_peak()
    except Exception as error:
        for cell in left:
            fail(cell, error)
    return statuses


def _check_data(case: Case) -> None:
    tasks = METHODS[case.cell.method].tasks
    if tasks is not None and case.cell.task not in tasks:
        raise ValueError(f"{case.cell.method} is only for {', '.join(tasks)}.")


def _use_one_thread() -> None:
    # Training depends on the number of threads, and a table must not.
    torch.set_num_threads(1)


def _row(case: Case, score: Score) -> dict[str, Any]:
    evaluation = score.evaluation
    names = case.task.parameter_names
    per_parameter = zip(names, evaluation.acauc.per_parameter.tolist(), strict=True)
    return {
        **asdict(score.cell),
        "status": "finished",
        **evaluation.as_row(),
        "lpp_standard_error": evaluation.lpp.standard_error,
        "acauc_standard_error": evaluation.acauc.standard_error,
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
        "git_commit": git_commit(),
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
        "log_probs": _shortened(evaluation.lpp.log_probs.cpu().numpy()),
        "coverage": evaluation.coverage.average.cpu().numpy().astype(np.float32),
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
def git_commit() -> str:
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
