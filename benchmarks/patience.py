"""How long and how fast a stack's candidates are fine-tuned, on calibration data.

    python -m benchmarks.patience --task pendulum --starts NPE tuned

A candidate is trained without each of some folds of the calibration pairs. The average
of these versions is scored on 300 others of the calibration set, not of the test set.
"""

import argparse
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.choices import calibration_data
from benchmarks.store import Cache
from sbi_rope.mixture import MixtureEstimator
from sbi_rope.stacking import FinetunedCandidate
from sbi_rope.stacking.folds import Fold, Workbench

__all__ = ["scores"]

RATES, PATIENCES = (1e-3, 3e-4), (20, 50)
SPACES = {"NPE": None, "embedding": "embedding", "input": "input", "tuned": "tuned"}


def scores(
    case: Case, n_calibration: int, starts: Sequence[str], *, num_versions: int
) -> Iterator[tuple[str, float, int, float]]:
    """Yield start, learning rate, patience and LPP in standard deviations of the prior.

    Args:
        case: Task, trained NPE and settings.
        n_calibration: Calibration pairs, in five folds.
        starts: What to fine-tune; "NPE", or the space that is corrected.
        num_versions: Folds to train without, one after the other.
    """
    rope, (theta, x) = calibration_data(case, n_calibration, seed=1)
    bench = Workbench(rope, num_folds=5, seed=1, show_progress_bars=False)
    numbers = range(len(bench.folds))
    folds = [
        Fold(bench, [number for number in numbers if number != left_out])
        for left_out in numbers[:num_versions]
    ]
    for start, rate, patience in itertools.product(starts, RATES, PATIENCES):
        candidate = FinetunedCandidate(space=SPACES[start])
        with (
            patch("sbi_rope.stacking.finetuning.PATIENCE", patience),
            patch.dict(
                "sbi_rope.stacking.trained_candidates.LEARNING_RATES",
                {candidate.space: rate},
            ),
        ):
            parts = [part for fold in folds for part in candidate.parts(fold)]
        estimator = MixtureEstimator(parts, [1.0 / len(parts)] * len(parts))
        log_prob = estimator.part_log_probs(theta, x).logsumexp(dim=1)
        lpp = log_prob.mean() - torch.tensor(float(len(parts))).log()
        yield start, rate, patience, float(lpp + case.task.prior_std.log().sum())


def main() -> None:
    """Print a table in Markdown."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True)
    parser.add_argument("--root", type=Path, help="folder of recorded data")
    parser.add_argument("--n-calibration", type=int, default=200)
    parser.add_argument("--starts", nargs="+", default=["NPE", "tuned"], choices=SPACES)
    parser.add_argument("--versions", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("results/patience"))
    args = parser.parse_args()
    case = Case.of(
        Cell(task=args.task, method="stack"),
        Sources(root=args.root),
        Cache(args.out / "cache"),
        "cpu",
    )
    print("| start | rate | patience | LPP |\n|---|---|---|---|")
    rows = scores(case, args.n_calibration, args.starts, num_versions=args.versions)
    for start, rate, patience, lpp in rows:
        print(f"| {start} | {rate:g} | {patience} | {lpp:.2f} |", flush=True)


if __name__ == "__main__":
    main()
