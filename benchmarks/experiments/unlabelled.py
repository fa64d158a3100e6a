"""Does a method that learns without labels help a stack, as one more candidate?

The method is trained on simulations and on the test observations without their labels.
Each row has the test scores of the method alone, of the usual stack, and of a stack
with the method among its candidates, which the calibration pairs give a weight. Rows
are kept in a file, and an interrupted run goes on where it was.

    python -m benchmarks.experiments.unlabelled --task cs sir
"""

import argparse
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

from benchmarks.experiments.common import Row, add_task, begin, kept_rows, show
from benchmarks.experiments.data import case_of
from benchmarks.methods import METHODS, append_data
from benchmarks.scoring import rope_of
from sbi_rope import stack
from sbi_rope.metrics import evaluate
from sbi_rope.stacking import DensityCandidate, default_candidates

COLUMNS = ("task", "repetition", "method", "pairs")
COLUMNS += ("lpp alone", "lpp without", "lpp with")
COLUMNS += ("acauc alone", "acauc without", "acauc with", "weight")
OPTIONS = {
    "--method": {"default": "RVNP", "help": "a method of the benchmark"},
    "--n-calibration": {"nargs": "+", "type": int, "default": (10, 50)},
    "--repetition": {"type": int, "default": 0},
}


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    for task in args.task:
        # Trained once for all numbers of pairs, and not at all if their rows are kept.
        trained = cache(partial(trained_method, args, task))
        for count in args.n_calibration:
            head = task, args.repetition, args.method, count
            yield tuple(map(str, head)), partial(score, args, task, count, trained)


def trained_method(args: argparse.Namespace, task: str) -> Any:
    """Return the posterior of the method without labels."""
    case = case_of(
        args, task, method=args.method, n_calibration=0, repetition=args.repetition
    )
    build = METHODS[args.method].build
    assert build is not None
    method = build(case)
    append_data(method, args.method, case)
    return method.train(seed=case.seed, show_progress_bars=False).build_posterior()


def score(
    args: argparse.Namespace, task: str, count: int, trained: Callable[[], Any]
) -> Row:
    """Return the test scores with and without the method."""
    case = case_of(args, task, n_calibration=count, repetition=args.repetition)
    std, (theta, x) = case.task.prior_std, case.test_set
    alone = trained()
    rope = rope_of(case).append_calibration(*case.calibration)
    more = DensityCandidate(name=args.method, build=lambda *_: alone, fixed=True)
    candidates = default_candidates(rope)
    options = {"seed": case.seed, "show_progress_bars": False}
    together = stack(rope, candidates=[*candidates, more], **options)
    posteriors = {
        "alone": alone,
        "without": stack(rope, candidates=candidates, **options),
        "with": together,
    }
    found = {"weight": f"{together.candidate_weights[args.method]:.2f}"}
    for name, posterior in posteriors.items():
        scores = evaluate(posterior, theta, x, theta_std=std, show_progress_bars=False)
        found[f"lpp {name}"] = f"{scores.lpp.standardised(std).mean:.3f}"
        found[f"acauc {name}"] = f"{scores.acauc.value:+.3f}"
    return {column: found[column] for column in COLUMNS[4:]}


def main() -> None:
    """Print the table."""
    args = begin(__doc__, add_task(OPTIONS, nargs="+"), threads=1)
    show(kept_rows(args.out / "unlabelled" / "rows.csv", COLUMNS, rows_of(args)))


if __name__ == "__main__":
    main()
