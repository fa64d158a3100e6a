"""How long and how fast are a stack's candidates to be fine-tuned?

The tables of rates and patiences of "The choices inside the stack" in
`benchmarks/choices.md`. A candidate is trained without each of some folds of the
calibration pairs. The average of these versions is scored on 300 others of the
calibration set, not of the test set.

    python -m benchmarks.experiments.patience --task pendulum --starts NPE tuned
    python -m benchmarks.experiments.patience --task pendulum --starts rehearsed \
        --rates 1e-3 2e-3 --patiences 10
"""

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import patch

from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import (
    average_lpp,
    calibration_data,
    case_of,
    some_folds,
)
from sbi_rope.stacking import FinetunedCandidate, RehearsedCandidate
from sbi_rope.stacking.finetuning import REHEARSED
from sbi_rope.trainers.training import FINETUNING

CANDIDATES = {
    "NPE": FinetunedCandidate(),
    "embedding": FinetunedCandidate(space="embedding"),
    "input": FinetunedCandidate(space="input"),
    "tuned": FinetunedCandidate(space="tuned"),
    "rehearsed": RehearsedCandidate(),
}
OPTIONS = {
    "--n-calibration": {"type": int, "default": 200},
    "--starts": {"nargs": "+", "default": ["NPE", "tuned"], "choices": CANDIDATES},
    "--rates": {"type": float, "nargs": "+", "default": [1e-3, 3e-4]},
    "--together": {
        "action": "store_true",
        "help": "also choose among the rates by the hold-out of each net",
    },
    "--patiences": {"type": int, "nargs": "+", "default": [20, 50]},
    "--versions": {"type": int, "default": 2, "help": "folds to train without"},
    "--seed": {"type": int, "default": 1, "help": "of the pairs"},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield LPPs in standard deviations of the prior, by start, rate and patience."""
    case = case_of(args, method="stack")
    rope, others = calibration_data(case, args.n_calibration, seed=args.seed)
    folds = some_folds(rope, args.versions, seed=args.seed)
    chosen = [(rate,) for rate in args.rates]
    if args.together:
        chosen.append(tuple(args.rates))
    for start, rates, patience in itertools.product(
        args.starts, chosen, args.patiences
    ):
        candidate = CANDIDATES[start]
        space = getattr(candidate, "space", None)
        trainings = {"FINETUNING": FINETUNING, "REHEARSED": REHEARSED}
        with (
            patch.multiple(
                "sbi_rope.stacking.finetuning",
                **{
                    name: replace(training, stop_after_epochs=patience)
                    for name, training in trainings.items()
                },
            ),
            patch.dict(
                "sbi_rope.stacking.trained_candidates.LEARNING_RATES", {space: rates}
            ),
        ):
            parts = [part for fold in folds for part in candidate.parts(fold)]
        lpp = average_lpp(parts, others, case.task)
        name = " or ".join(f"{rate:g}" for rate in rates)
        setting = {"start": start, "rate": name, "patience": patience}
        yield {**setting, "LPP": f"{lpp:.2f}"}


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS), threads=1)))
