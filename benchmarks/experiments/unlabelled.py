"""Do observations without labels help a stack, by RVNP as one more candidate?

RVNP learns errors from the first test observations, without their labels, and the
calibration pairs give it a weight. Each row has the test scores of the usual stack and
of one with RVNP among its candidates, which may be asked about any observation. Rows
are kept in a file, and an interrupted run goes on where it was.

    python -m benchmarks.experiments.unlabelled --task cs sir
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial

from benchmarks.experiments.common import Row, add_task, begin, kept_rows, show
from benchmarks.experiments.data import case_of
from benchmarks.scoring import rope_of
from sbi_rope import stack
from sbi_rope.metrics import evaluate
from sbi_rope.stacking import default_candidates

COLUMNS = ("task", "repetition", "observations", "pairs", "lpp without", "lpp with")
COLUMNS += ("acauc without", "acauc with", "weight")
OPTIONS = {
    "--num-observations": {"nargs": "+", "type": int, "default": (1000,)},
    "--n-calibration": {"nargs": "+", "type": int, "default": (10, 50)},
    "--repetition": {"type": int, "default": 0},
}


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    for task in args.task:
        for num_observations in args.num_observations:
            for count in args.n_calibration:
                head = task, args.repetition, num_observations, count
                compute = partial(score, args, task, num_observations, count)
                yield tuple(map(str, head)), compute


def score(
    args: argparse.Namespace, task: str, num_observations: int, count: int
) -> Row:
    """Return the test scores without and with the observations."""
    case = case_of(args, task, n_calibration=count, repetition=args.repetition)
    std, (theta, x) = case.task.prior_std, case.test_set
    rope = rope_of(case).append_calibration(*case.calibration)
    found: Row = {}
    for name, x_o in (("without", None), ("with", x[:num_observations])):
        posterior = stack(
            rope,
            candidates=default_candidates(rope, x_o),
            seed=case.seed,
            show_progress_bars=False,
        )
        scores = evaluate(posterior, theta, x, theta_std=std, show_progress_bars=False)
        found[f"lpp {name}"] = f"{scores.lpp.standardised(std).mean:.3f}"
        found[f"acauc {name}"] = f"{scores.acauc.value:+.3f}"
        weight = posterior.report.family_weights.get("RVNP", 0.0)
        found["weight"] = f"{weight:.2f}"
    return {column: found[column] for column in COLUMNS[4:]}


def main() -> None:
    """Print the table."""
    args = begin(__doc__, add_task(OPTIONS, nargs="+"), threads=1)
    show(kept_rows(args.out / "unlabelled" / "rows.csv", COLUMNS, rows_of(args)))


if __name__ == "__main__":
    main()
