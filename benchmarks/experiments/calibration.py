"""Is a stack calibrated, before and after recalibration, and what do its sets hold?

Each row is a stack of a task: its scores on the test set as it is and recalibrated, and
the share of the first test observations whose parameters are in their 90 % sets, of
highest density and with a guarantee. "ratio" is the median ratio of the volumes of the
two sets. Rows are kept in a file, and an interrupted run goes on where it was.

    python -m benchmarks.experiments.calibration --task sir cs

Recalibration trains two to three times as many versions. With `--sets-only` it is left
out, and so are its columns.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from benchmarks.experiments.common import Row, add_task, begin, kept_rows, show
from benchmarks.experiments.data import case_of
from benchmarks.scoring import rope_of
from sbi_rope import MixturePosterior, stack
from sbi_rope.metrics import evaluate

LEVEL = 0.9
CELL = ("task", "variant", "pairs", "repetition")
SCORES = ("lpp", "acauc")
SETS = ("held", "held with a guarantee", "ratio")
COLUMNS = (*CELL, "factors", "lpp", "lpp after", "acauc", "acauc after", *SETS)
OPTIONS = {
    "--n-calibration": {"nargs": "+", "type": int, "default": (10, 50, 200)},
    "--repetition": {"type": int, "default": 0},
    "--num-sets": {"type": int, "default": 200, "help": "test observations with sets"},
    "--num-samples": {"type": int, "default": 200, "help": "draws for a volume"},
    "--sets-only": {"action": "store_true", "help": "leave recalibration out"},
}


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    for count in args.n_calibration:
        for task in args.task:
            head = task, args.variant, count, args.repetition
            yield tuple(map(str, head)), partial(score, args, task, count)


def score(args: argparse.Namespace, task: str, n_calibration: int) -> dict[str, str]:
    """Return the scores of a stack, as it is and recalibrated."""
    repetition = args.repetition
    case = case_of(args, task, n_calibration=n_calibration, repetition=repetition)
    std, (theta, x) = case.task.prior_std, case.test_set
    rope = rope_of(case).append_calibration(*case.calibration)
    posterior = stack(
        rope,
        recalibrate=not args.sets_only,
        seed=case.seed,
        show_progress_bars=False,
    )
    report = posterior.report
    found, plain, scored = {}, posterior, [(posterior, "")]
    if report.recalibration is not None:
        factors = report.recalibration.factors
        found["factors"] = " ".join(f"{factor:.2f}" for factor in factors)
        plain = MixturePosterior(
            posterior.versions.estimator(report.cross_validation.weights.weights),
            posterior.prior,
        )
        scored = [(plain, ""), (posterior, " after")]
    for one, name in scored:
        scores = evaluate(one, theta, x, theta_std=std, show_progress_bars=False)
        found[f"lpp{name}"] = f"{scores.lpp.standardised(std).mean:.3f}"
        found[f"acauc{name}"] = f"{scores.acauc.value:+.3f}"
    return found | sets_of(posterior, plain, theta, x, args)


def sets_of(
    posterior: MixturePosterior,
    plain: MixturePosterior,
    theta: Tensor,
    x: Tensor,
    args: argparse.Namespace,
) -> dict[str, str]:
    """Return the share of parameters in their sets, and how large the sets are."""
    held, guaranteed, ratios = [], [], []
    for number in range(min(args.num_sets, len(x))):
        options = {"num_samples": args.num_samples, "seed": number}
        first = plain.credible_set(LEVEL, x[number], **options)
        second = posterior.credible_set(LEVEL, x[number], guaranteed=True, **options)
        held.append(first.contains(theta[[number]]))
        guaranteed.append(second.contains(theta[[number]]))
        ratios.append(second.volume / first.volume)
    return {
        "held": f"{torch.cat(held).double().mean():.3f}",
        "held with a guarantee": f"{torch.cat(guaranteed).double().mean():.3f}",
        "ratio": f"{torch.tensor(ratios).median():.2f}",
    }


def main() -> None:
    """Print the table."""
    args = begin(__doc__, add_task(OPTIONS, nargs="+"), threads=1)
    if args.sets_only:
        path, columns = args.out / "sets" / "rows.csv", (*CELL, *SCORES, *SETS)
    else:
        path, columns = args.out / "calibration" / "rows.csv", COLUMNS
    show(kept_rows(path, columns, rows_of(args)))


if __name__ == "__main__":
    main()
