"""How long is a stack to train its discrepancy models?

The tables of courses of "The choices inside the stack" in `benchmarks/choices.md`. A
discrepancy model is trained on the calibration pairs without each of some folds. The
average of these versions is scored on 300 others of the calibration set, not of the
test set.

    python -m benchmarks.experiments.courses --task pendulum --n-calibration 50
"""

import argparse
import time
from collections.abc import Iterator
from unittest.mock import patch

from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import (
    average_lpp,
    calibration_data,
    case_of,
    some_folds,
)
from sbi_rope.discrepancy.training import ONE_COURSE
from sbi_rope.stacking import DiscrepancyCandidate, FinetunedCandidate
from sbi_rope.stacking.candidates import AmortisedCandidate

OPTIONS = {
    "--n-calibration": {"type": int, "default": 50},
    "--spaces": {"nargs": "+", "default": ["embedding", "tuned"]},
    "--gains": {"type": float, "nargs": "+", "default": [0.1, 0.03, 0.01]},
    "--finetuned": {"action": "store_true", "help": "score them fine-tuned, too"},
    "--versions": {"type": int, "default": 2, "help": "folds to train without"},
    "--seed": {"type": int, "default": 1, "help": "of the pairs"},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield LPPs in standard deviations of the prior, by space and rule."""
    case = case_of(args, method="stack")
    rope, others = calibration_data(case, args.n_calibration, seed=args.seed)
    rules = {
        "one": ONE_COURSE,
        **{f"while they gain {gain:g}": gain for gain in args.gains},
    }
    for space in args.spaces:
        candidates: list[AmortisedCandidate] = [DiscrepancyCandidate(space=space)]
        if args.finetuned:
            candidates.append(FinetunedCandidate(space=space))
        for name, min_gain in rules.items():
            # Folds keep what was trained, so that each rule needs its own.
            folds = some_folds(rope, args.versions, seed=args.seed)
            row = {"space": space, "courses": name}
            start = time.process_time()
            with patch("sbi_rope.stacking.folds.IN_A_STACK", min_gain):
                for candidate in candidates:
                    parts = [part for fold in folds for part in candidate.parts(fold)]
                    lpp = average_lpp(parts, others, case.task)
                    row[candidate.name] = f"{lpp:.2f}"
            yield row | {"s": f"{time.process_time() - start:.0f}"}


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS), threads=1)))
