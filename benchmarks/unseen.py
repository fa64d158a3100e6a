"""One observation at a time: what a stack costs outside the batch it was fitted to.

    python -m benchmarks.unseen --task light_tunnel_sensors --root FOLDER

fits a stack to a batch and scores it on 300 other observations, whose rows extend its
couplings (`unseen="extend"`); and again with these observations in the batch.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.store import Cache
from sbi_rope import RoPE, stack
from sbi_rope.metrics import evaluate

__all__ = ["scores"]

NUM_OTHERS = 300


def scores(case: Case, size: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return the scores of others outside of a batch of some size, and in it."""
    theta, x = case.test_set
    batch, others, theta = x[NUM_OTHERS:][:size], x[:NUM_OTHERS], theta[:NUM_OTHERS]
    rope = RoPE(
        case.npe, simulator=case.simulator, finetuner=case.settings.finetuner
    ).append_calibration(*case.calibration)
    rope.train(seed=case.seed, show_progress_bars=False)

    def score(x_o: Tensor) -> dict[str, float]:
        posterior = stack(
            rope, x_o, unseen="extend", seed=case.seed, show_progress_bars=False
        )
        evaluation = evaluate(
            posterior,
            theta,
            others,
            theta_std=case.task.prior_std,
            num_samples=case.settings.num_samples,
            seed=case.seed,
        )
        return evaluation.as_row()

    return score(batch), score(torch.cat([batch, others]))


def main() -> None:
    """Print one row for each size of the batch."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True, help="one with a simulator")
    parser.add_argument("--root", type=Path, help="folder of recorded data")
    parser.add_argument("--n-calibration", type=int, default=50)
    parser.add_argument("--sizes", type=int, nargs="+", default=[20, 100, 500])
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--out", type=Path, default=Path("results/unseen"))
    args = parser.parse_args()
    cell = Cell(
        task=args.task,
        preset=args.preset,
        method="stack",
        n_calibration=args.n_calibration,
    )
    case = Case.of(cell, Sources(root=args.root), Cache(args.out), "cpu")
    print("| batch | LPP extended | ACAUC | LPP in the batch | ACAUC |")
    print("|---|---|---|---|---|")
    for size in args.sizes:
        outside, inside = scores(case, size)
        entries = (
            f"{row['lpp_z']:.2f} | {row['acauc']:+.3f}" for row in (outside, inside)
        )
        print(f"| {size} | {' | '.join(entries)} |", flush=True)


if __name__ == "__main__":
    main()
