"""Do the observations that the candidates of a stack disagree on teach it more?

A stack is made of a few labels. Then more observations of a pool are labelled: at
random, or those with the largest Jensen-Shannon divergence between the candidates,

    sum_k w_k E[log p_k(theta | x) - log p(theta | x)],    theta ~ p_k,

which is what the label would tell about the candidates. A stack is made of all labels
and scored on other rows of the calibration set. The learning curve of the first stack
says beforehand what the labels would add. Rows are kept in a file, and an
interrupted run goes on where it was.

    python -m benchmarks.experiments.active --task sir
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.experiments.common import Row, add_task, begin, kept_rows, show
from benchmarks.experiments.data import calibration_data, case_of
from benchmarks.scoring import rope_of
from sbi_rope import stack
from sbi_rope.metrics import evaluate
from sbi_rope.stacking import StackedPosterior

# The rows that are scored come after those of the pool.
NUM_POOL = 150
NUM_DRAWS = 100
COLUMNS = ("task", "pairs", "more", "repetition", "expected gain", "interval")
COLUMNS += ("first", "random", "disagreement")
OPTIONS = {
    "--n-calibration": {"type": int, "default": 20, "help": "the first labels"},
    "--more": {"type": int, "default": 10, "help": "labels that are added"},
    "--repetitions": {"type": int, "default": 5},
}


def disagreement(posterior: StackedPosterior, x: Tensor, *, seed: int) -> Tensor:
    """Return the Jensen-Shannon divergence of the candidates given each x, ``(n,)``."""
    weights = torch.tensor(list(posterior.candidate_weights.values()))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        theta = posterior.sample_batched((NUM_DRAWS,), x, show_progress_bars=False)
    divergence = torch.zeros(len(x), dtype=torch.double)
    for draw in theta:
        log_probs = posterior.candidate_log_probs(draw, x)
        log_mixture = torch.logsumexp(log_probs + weights.log(), dim=1, keepdim=True)
        # Draws of the mixture are weighted to be draws of each candidate.
        shares = weights * (log_probs - log_mixture).exp()
        divergence += torch.special.xlogy(shares, shares / weights).nansum(dim=1)
    return divergence / NUM_DRAWS


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    for repetition in range(args.repetitions):
        head = args.task, args.n_calibration, args.more, repetition
        yield tuple(map(str, head)), partial(score, args, repetition)


def score(args: argparse.Namespace, repetition: int) -> dict[str, str]:
    """Return the scores of a stack of the first labels, and with more of them."""
    count, seed = args.n_calibration, 100 + repetition
    case = case_of(args, n_calibration=count, repetition=0)
    rope, (theta, x) = calibration_data(case, count, seed=seed)
    pairs = rope.calibration
    std = case.task.prior_std
    pool, scored = slice(0, NUM_POOL), slice(NUM_POOL, None)

    def score_of(posterior: StackedPosterior) -> Any:
        found = evaluate(
            posterior, theta[scored], x[scored], theta_std=std, show_progress_bars=False
        )
        return found.lpp.standardised(std).mean

    first = stack(rope, learning_curve=True, seed=seed, show_progress_bars=False)
    curve = first.report.learning_curve
    assert curve is not None
    gain = curve.gain(args.more)
    divergence = disagreement(first, x[pool], seed=seed)
    order = torch.randperm(NUM_POOL, generator=torch.Generator().manual_seed(seed))
    chosen = {
        "random": order[: args.more],
        "disagreement": divergence.argsort(descending=True)[: args.more],
    }
    found = {
        "expected gain": f"{gain.mean:.3f}",
        "interval": f"{gain.low:.3f} to {gain.high:.3f}",
        "first": f"{score_of(first):.3f}",
    }
    for name, rows in chosen.items():
        more = rope_of(case).append_calibration(*pairs)
        more.append_calibration(theta[pool][rows], x[pool][rows])
        posterior = stack(more, seed=seed, show_progress_bars=False)
        found[name] = f"{score_of(posterior):.3f}"
    return found


def main() -> None:
    """Print the table."""
    args = begin(__doc__, add_task(OPTIONS), threads=1)
    show(kept_rows(args.out / "active" / "rows.csv", COLUMNS, rows_of(args)))


if __name__ == "__main__":
    main()
