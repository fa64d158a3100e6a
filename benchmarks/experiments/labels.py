"""What do labels cost that are noisy, or partial, if the stack is told, and if not?

Each row is a stack without a batch, scored on the test set. Noise is normal, as a share
of the prior's standard deviation, and drawn again where it leaves the prior. Partial
labels miss each parameter in half of the pairs. Rows are kept in a file, and an
interrupted run goes on where it was.

    python -m benchmarks.experiments.labels --task sir
"""

import argparse
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.experiments.common import Row, add_task, begin, kept_rows, show
from benchmarks.experiments.data import case_of
from benchmarks.scoring import rope_of
from sbi_rope import stack
from sbi_rope.metrics import evaluate
from sbi_rope.tasks.variants import with_label_noise

NOISE = (0.01, 0.05, 0.1, 0.2, 0.5)
COLUMNS = ("task", "repetition", "pairs", "labels", "told", "lpp", "error", "acauc")
OPTIONS = {
    "--n-calibration": {"type": int, "default": 50},
    "--noise": {"nargs": "*", "type": float, "default": NOISE},
    "--partial": {"action": "store_true", "help": "also partial labels, and half of n"},
    "--repetition": {"type": int, "default": 0},
}


def settings_of(args: argparse.Namespace) -> Iterator[tuple[str, bool, dict[str, Any]]]:
    """Yield the name of each setting, whether it is told, and what it is."""
    yield "exact", True, {}
    for noise in args.noise:
        for told in (False, True):
            yield f"noise {noise:g}", told, {"noise": noise}
    if args.partial:
        yield "half of the pairs, exact", True, {"share": 0.5}
        yield "each parameter in half of the pairs", True, {"is_partial": True}


def score(
    case: Any,
    *,
    told: bool,
    noise: float = 0.0,
    share: float = 1.0,
    is_partial: bool = False,
) -> dict[str, str]:
    """Return the test scores of a stack, with theta in the prior's deviations."""
    theta, x = case.calibration
    std = case.task.prior_std
    options: dict[str, Any] = {}
    if noise:
        prior = case.task.get_prior()
        theta = with_label_noise(theta, noise * std, prior, seed=case.seed)
        options = {"theta_std": noise * std} if told else {}
    if is_partial:
        # Half of the pairs miss each parameter, whichever they are.
        generator = torch.Generator().manual_seed(case.seed)
        order = torch.rand(theta.shape, generator=generator).argsort(dim=0)
        theta = theta.where(order < len(theta) // 2, math.nan)
    rows = slice(0, round(share * len(theta)))
    rope = rope_of(case).append_calibration(theta[rows], x[rows], **options)
    posterior = stack(rope, seed=case.seed, show_progress_bars=False)
    found = evaluate(posterior, *case.test_set, theta_std=std, show_progress_bars=False)
    return {
        "lpp": f"{found.lpp.standardised(std).mean:.3f}",
        "error": f"{found.lpp.standard_error:.3f}",
        "acauc": f"{found.acauc.value:+.3f}",
    }


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    case = case_of(args, n_calibration=args.n_calibration, repetition=args.repetition)
    for labels, told, setting in settings_of(args):
        head = args.task, args.repetition, args.n_calibration, labels
        yield (
            (*map(str, head), "yes" if told else "no"),
            partial(score, case, told=told, **setting),
        )


def main() -> None:
    """Print the table."""
    args = begin(__doc__, add_task(OPTIONS), threads=1)
    show(kept_rows(args.out / "labels" / "rows.csv", COLUMNS, rows_of(args)))


if __name__ == "__main__":
    main()
