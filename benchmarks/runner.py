"""Runs cells, in parallel, and keeps what is finished."""

import contextlib
import subprocess
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import joblib
import torch
from tqdm.auto import tqdm

from benchmarks.cases import Case, Workplace
from benchmarks.cells import Cell
from benchmarks.scoring import failure, score
from benchmarks.store import Result, Results

ROOT = Path(__file__).parents[1]
PACKAGES = ("torch", "sbi", "POT", "numpy")
# What scores depend on.
CODE = [
    "sbi_rope",
    *(f"benchmarks/{name}.py" for name in ("cases", "methods", "presets", "scoring")),
]


def run_cells(
    cells: Sequence[Cell],
    results: Results,
    place: Workplace,
    *,
    jobs: int = 1,
    again: bool = False,
    retry: bool = False,
) -> Counter[str]:
    """Run the cells that have no result yet, and count how they ended.

    The first repetition of all cells comes first, so that a run that is stopped leaves
    a table of all methods.

    Args:
        cells: What to run.
        results: Where results are kept, each as soon as it is there.
        place: What cells are run on.
        jobs: Cells computed at a time, or cells that share a training.
        again: Whether to compute anew what another version of the code has made.
        retry: Whether to compute failed cells anew.

    Returns:
        The number of cells that were ``"kept"``, ``"finished"`` and ``"failed"``.
    """
    results.take_over(cells)
    commit = code_version()
    rows = results.rows
    if again:
        # Nobody knows whether two changed versions are the same.
        rows = rows[(rows["git_commit"] == commit) & (not commit.endswith("+"))]
    if retry:
        rows = rows[rows["status"] != "failed"]
    known = {*rows.index}
    waiting = [cell for cell in cells if cell not in known]
    groups: dict[Cell, list[Cell]] = {}
    for cell in sorted(waiting, key=lambda cell: cell.repetition):
        groups.setdefault(cell.training, []).append(cell)
    counts = Counter(kept=len(cells) - len(waiting), finished=0, failed=0)
    run = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
    # What methods share is made first, so that no two jobs make it at the same time.
    shared = {cell.data: cell for cell in groups}.values()
    for _ in run(joblib.delayed(prepare)(cell, place) for cell in shared):
        pass
    with tqdm(total=len(waiting), desc="Cells", smoothing=0.1) as bar:
        for found in run(
            joblib.delayed(run_group)(cell, group, place, commit)
            for cell, group in groups.items()
        ):
            results.add(found)
            counts.update(result.row["status"] for result in found)
            bar.update(len(found))
    return counts


def prepare(cell: Cell, place: Workplace) -> None:
    """Draw the simulations and train the NPE of a cell, if they are not there yet."""
    # Training depends on the number of threads, and a table must not.
    torch.set_num_threads(1)
    # An error comes again when the cell is run.
    with contextlib.suppress(Exception):
        _ = Case(cell, place).npe


def run_group(
    training: Cell, cells: Sequence[Cell], place: Workplace, commit: str
) -> list[Result]:
    """Run cells that share a training; what fails has a result, too."""
    torch.set_num_threads(1)
    results: list[Result] = []

    def keep(result: Result) -> None:
        result.row.update(
            device=place.device,
            versions="; ".join(f"{name} {version(name)}" for name in PACKAGES),
            git_commit=commit,
            finished_at=time.strftime("%Y-%m-%dT%H:%M:%S"),
        )
        results.append(result)

    try:
        for result in score(Case(training, place), cells):
            keep(result)
    except Exception as error:
        traceback.print_exc()
        for cell in cells[len(results) :]:
            keep(failure(cell, error))
    return results


def code_version() -> str:
    """Return the last commit of what scores depend on, with a plus if it was changed.

    Commits of results, pages and documentation make no other version.
    """

    def git(*args: str) -> str:
        command = ("git", "-C", str(ROOT), *args, "--", *CODE)
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        return found.stdout.strip()

    commit = git("log", "-1", "--format=%h")
    return (commit or "unknown") + ("+" if git("status", "--porcelain") else "")
