"""How many pairs do several recordings of one person or specimen count as?

Real observations have six entries, z = A m + b + e, where the simulated means m depend
on three parameters. Errors of recordings of one specimen have a correlation, in all
entries or in every second one. The discrepancy is learned from some specimens with
several recordings each. It is scored by the log density of single recordings of 400
other specimens: with every recording as a pair of its own, with every specimen as one
pair, and as the package does it. Errors are standard errors of the difference from it.
A simulator that is right has the distribution of single recordings.

    python -m benchmarks.experiments.recordings
"""

import argparse
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from benchmarks.experiments.common import Row, begin, show
from sbi_rope.discrepancy import Discrepancy, DiscrepancyModel
from sbi_rope.discrepancy.correction import LARGEST_SURPRISE, surprise

WIDTH, NUM_PARAMETERS = 6, 3
NUM_SCORED, NUM_DRAWS = 400, 1500
# The simulator's own noise. Errors of the wrong simulator are larger.
NOISE, ERROR = 0.3, 0.5
SIZES = ((5, 20), (10, 5), (20, 3))
CORRELATIONS = (0.0, 0.3, 0.95, "0.95 in half of the entries")
OPTIONS = {
    "--trials": {"type": int, "default": 20},
    "--seed": {"type": int, "default": 0, "help": "of the random numbers"},
}


class Reality:
    """A process that differs from the simulator, or not."""

    def __init__(self, *, right: bool, correlation: Any) -> None:
        share = 0.0 if right else 0.3
        self.loadings = torch.randn(WIDTH, NUM_PARAMETERS).double() / 1.5
        noise = torch.randn(WIDTH, WIDTH) / math.sqrt(WIDTH)
        self.gain = (torch.eye(WIDTH) + share * noise).double()
        self.offset = (0.0 if right else 0.5) * torch.randn(WIDTH).double()
        self.std = NOISE if right else ERROR
        if isinstance(correlation, str):
            self.common = torch.tensor([0.0, 0.95]).repeat(WIDTH // 2)
        else:
            self.common = torch.full((WIDTH,), correlation)

    def draw(self, specimens: int, recordings: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return observations, their simulated means, and the specimens."""
        groups = torch.arange(specimens).repeat_interleave(recordings)
        mean = (torch.randn(specimens, NUM_PARAMETERS).double() @ self.loadings.T)[
            groups
        ]
        common = self.common.sqrt() * torch.randn(specimens, WIDTH)[groups]
        own = (1 - self.common).sqrt() * torch.randn(len(groups), WIDTH)
        z = mean @ self.gain.T + self.offset + self.std * (common + own)
        return z, mean, groups


def fitted(
    z: Tensor, mean: Tensor, known: Tensor | None = None, **options: Tensor
) -> Discrepancy:
    """Fit the discrepancy as the candidates of a stack do.

    Args:
        z: Observations.
        mean: Their simulated means.
        known: The specimens, if they are known where the simulator is to be refuted.
        **options: What the model counts the pairs by.
    """
    noise = NOISE**2 * torch.eye(WIDTH).double()
    found = surprise(z, mean, noise.expand(len(z), -1, -1), groups=known)
    if found > LARGEST_SURPRISE:
        return DiscrepancyModel(probability_of_none=0.0).fit(z, mean, noise, **options)
    return DiscrepancyModel().fit(z, mean, noise, **options)


def score(discrepancy: Discrepancy, z: Tensor, mean: Tensor) -> float:
    """Return the mean log density of other observations."""
    draws = discrepancy.sample(NUM_DRAWS, seed=0)
    covariance = draws.error_factor @ draws.error_factor.mT
    covariance = covariance + draws.gain @ discrepancy.noise @ draws.gain.mT
    expected = torch.einsum("kij,nj->nki", draws.gain, mean) + draws.offset
    normal = MultivariateNormal(expected, covariance)
    log_density = normal.log_prob(z[:, None]).logsumexp(dim=1) - math.log(NUM_DRAWS)
    return float(log_density.mean())


def scores(reality: Reality, specimens: int, recordings: int) -> list[float]:
    """Return the scores of the three ways to count."""
    z, mean, groups = reality.draw(specimens, recordings)
    weights = torch.full((len(z),), 1 / recordings).double()
    ways = [
        fitted(z, mean),
        fitted(z, mean, groups, weights=weights),
        fitted(z, mean, groups, groups=groups),
    ]
    others = reality.draw(NUM_SCORED, 1)[:2]
    return [score(discrepancy, *others) for discrepancy in ways]


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each kind of specimens."""
    for right in (True, False):
        for specimens, recordings in SIZES:
            for correlation in CORRELATIONS:
                torch.manual_seed(args.seed)
                found = [
                    scores(
                        Reality(right=right, correlation=correlation),
                        specimens,
                        recordings,
                    )
                    for _ in range(args.trials)
                ]
                columns = torch.tensor(found)
                mean = columns.mean(dim=0)
                error = (columns - columns[:, 2:]).std(dim=0) / args.trials**0.5
                yield {
                    "simulator": "right" if right else "wrong",
                    "specimens": specimens,
                    "recordings": recordings,
                    "correlation": correlation,
                    "all independent": f"{mean[0]:.2f} ± {error[0]:.2f}",
                    "one pair each": f"{mean[1]:.2f} ± {error[1]:.2f}",
                    "the package": f"{mean[2]:.2f}",
                }


if __name__ == "__main__":
    show(rows_of(begin(__doc__, OPTIONS)))
