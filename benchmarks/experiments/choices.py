"""Which candidates, what prior of the weights, how much refitting does a stack need?

The first tables of "The choices inside the stack" in `benchmarks/choices.md`. All
candidates are trained on some calibration pairs, without each fold of them and on all,
and every version is scored on 300 others of the calibration set, not of the test set.
Choices are compared by what their stacks would have scored, so that none needs a second
run. Runs are kept, so that the experiment can be interrupted.

    python -m benchmarks.experiments.choices --task pendulum --n-calibration 10
"""

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import torch
from torch import Tensor

from benchmarks.cases import Case
from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import calibration_data, case_of
from sbi_rope import stack
from sbi_rope.stacking import default_candidates, stacking_weights

__all__ = ["CHOICES", "Choice", "Run", "comparison", "run"]

OPTIONS = {
    "--n-calibration": {"type": int, "default": 10},
    "--folds": {"type": int, "default": 5},
    "--seeds": {"type": int, "nargs": "+", "default": [1, 2, 3]},
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """What a stack was made from, and how its candidates did on other pairs.

    Attributes:
        seconds: That the training took.
        names: Of the candidates, K of them.
        fold: The fold of each pair, shape ``(n,)``.
        held_out: Log scores on held-out pairs, shape ``(n, K)``.
        others: Log density of other pairs under each version, in standard deviations of
            the prior, shape ``(V, m, K)``; the last version is trained on all pairs.
    """

    seconds: float
    names: tuple[str, ...]
    fold: Tensor
    held_out: Tensor
    others: Tensor

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return len(self.others) - 1

    def candidate_scores(self, refit: float) -> Tensor:
        """Return the log density of other pairs under each candidate, ``(m, K)``."""
        shares = torch.full((len(self.others),), (1.0 - refit) / self.num_folds)
        shares[-1] = refit
        return (self.others + shares.double().log()[:, None, None]).logsumexp(dim=0)


def run(case: Case, n_calibration: int, num_folds: int, seed: int) -> Run:
    """Stack on pairs of the calibration set, and score on others of it."""
    rope, (theta, x) = calibration_data(case, n_calibration, seed=seed)
    start = time.process_time()
    posterior = stack(rope, num_folds=num_folds, seed=seed, show_progress_bars=False)
    seconds = time.process_time() - start
    versions, scores = posterior.versions, posterior.report.cross_validation
    others = [versions.log_probs(theta, x, [v]) for v in range(len(versions.trained))]
    return Run(
        seconds=seconds,
        names=scores.names,
        fold=scores.fold,
        held_out=scores.log_scores,
        others=torch.stack(others) + case.task.prior_std.log().sum(),
    )


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One way to make a stack.

    Attributes:
        without: Names of candidates that are left out.
        pseudo_count: As in :func:`sbi_rope.stacking.stacking_weights`.
        refit: Share of the version that is trained on all pairs; None for that of
            every other version.
    """

    without: tuple[str, ...] = ()
    pseudo_count: float = 1.0
    refit: float | None = None

    def weights(self, run: Run) -> Tensor:
        """Return the weights of all candidates; zero for those that are left out."""
        kept = torch.tensor([name not in self.without for name in run.names])
        found = stacking_weights(run.held_out[:, kept], pseudo_count=self.pseudo_count)
        weights = torch.zeros(len(run.names), dtype=torch.double)
        weights[kept] = found.weights
        return weights

    def score(self, run: Run) -> float:
        """Return the mean log density of other pairs under the stack.

        Not corrected for leakage: a lower bound.
        """
        refit = 1.0 / (run.num_folds + 1) if self.refit is None else self.refit
        scores = run.candidate_scores(refit) + self.weights(run).log()
        return float(scores.logsumexp(dim=1).mean())


CHOICES = {
    "refit as one more version (default)": Choice(),
    "no refit": Choice(refit=0.0),
    "half of it refit": Choice(refit=0.5),
    "refit only": Choice(refit=1.0),
    "pseudo-count .3": Choice(pseudo_count=0.3),
    "pseudo-count 3": Choice(pseudo_count=3.0),
    "pseudo-count 10": Choice(pseudo_count=10.0),
    "without fine-tuned NPE": Choice(without=("fine-tuned NPE",)),
    "without fine-tuned NPE, rehearsed": Choice(without=("fine-tuned NPE, rehearsed",)),
    "without discrepancy, fine-tuned": Choice(without=("discrepancy, fine-tuned",)),
    "without discrepancy (input) and (tuned), fine-tuned": Choice(
        without=("discrepancy (input), fine-tuned", "discrepancy (tuned), fine-tuned")
    ),
    "without discrepancy": Choice(without=("discrepancy",)),
    "without discrepancy (input)": Choice(without=("discrepancy (input)",)),
    "without discrepancy (tuned)": Choice(without=("discrepancy (tuned)",)),
    "without the prior": Choice(without=("prior",)),
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield the gains of each choice on each task."""
    runs = {}
    for task in args.task:
        case = case_of(args, task, method="stack")
        runs["-".join(filter(None, (task, args.variant)))] = [
            case.cache.get(
                "choices",
                {
                    "task": [task, args.variant, args.preset],
                    "pairs": args.n_calibration,
                    "folds": args.folds,
                    "seed": seed,
                    "candidates": [one.name for one in default_candidates()],
                },
                lambda s=seed, c=case: run(c, args.n_calibration, args.folds, s),
                pack=vars,
                unpack=lambda kept: Run(**kept),
            )
            for seed in args.seeds
        ]
    yield from comparison(runs)


def comparison(runs: Mapping[str, Sequence[Run]]) -> Iterator[Row]:
    """Yield choices against tasks, as gains over the first choice.

    The last rows are the best single candidate, chosen on the pairs it is scored on,
    the one with the best held-out score, and the seconds.

    Args:
        runs: By task, one for each draw of the pairs.
    """

    def line(name: str, values: Sequence[float], form: str) -> dict[str, str]:
        named = dict(zip((*runs, "mean"), (*values, mean(values)), strict=True))
        return {"choice": name, **{n: f"{value:{form}}" for n, value in named.items()}}

    def means(score: Callable[[Run], float]) -> list[float]:
        return [mean(map(score, part)) for part in runs.values()]

    name, first = next(iter(CHOICES.items()))
    base = means(first.score)
    lpps = line(f"{name}, LPP", base, ".2f")
    yield lpps | {n: f"{lpps[n]} ({len(part)})" for n, part in runs.items()}
    scores: dict[str, Callable[[Run], float]] = {
        **{name: choice.score for name, choice in CHOICES.items()},
        "best single candidate": _best,
        "best held-out candidate": _picked,
    }
    for name, score in scores.items():
        gains = [gain - b for gain, b in zip(means(score), base, strict=True)]
        yield line(name, gains, "+.2f")
    yield line("seconds", means(lambda run: run.seconds), ".0f")


def _single(run: Run) -> Tensor:
    return run.candidate_scores(1.0 / (run.num_folds + 1)).mean(dim=0)


def _best(run: Run) -> float:
    return float(_single(run).max())


def _picked(run: Run) -> float:
    return float(_single(run)[run.held_out.mean(dim=0).argmax()])


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS, nargs="+"), threads=1)))
