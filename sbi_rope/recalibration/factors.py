r"""How much narrower or wider posteriors have to be, from held-out pairs.

The factors maximise the log density of held-out pairs, with a prior around 1:

.. math:: \log s_j = c + \delta_j, \qquad c \sim N(0, 0.3^2), \qquad
    \delta_j \sim N(0, 0.15^2)

So few pairs choose one factor for all parameters, and one near 1. Many pairs choose one
for each. The density is computed on a grid of c, and then on a grid of each
:math:`\delta_j` at the best c. What several :math:`\delta_j` change is taken to add up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sbi_rope.metrics.calibration import central_levels, count_ranks
from sbi_rope.mixture.sampling import Accept
from sbi_rope.recalibration.estimator import RecalibratedEstimator
from sbi_rope.recalibration.spread import Spread

__all__ = ["Choice", "HeldOutGrid", "HeldOutMixture"]

# The grids of c and of each delta, and the standard deviations of their priors.
COMMON = torch.linspace(-1.2, 1.2, 49, dtype=torch.double)
OWN = torch.linspace(-0.6, 0.6, 25, dtype=torch.double)
COMMON_STD, OWN_STD = 0.3, 0.15
# Draws at each pair, from which the calibration is computed.
NUM_DRAWS = 500


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutMixture:
    """A mixture, and pairs that it has not seen.

    Attributes:
        estimator: The mixture, with factors of 1.
        theta: Parameters inside the support, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event)``.
        accept: Tells which parameters ``(n, d)`` are inside the support; None if all
            inside the bounds are.
    """

    estimator: RecalibratedEstimator
    theta: Tensor
    x: Tensor
    accept: Accept | None = None

    @cached_property
    def spread(self) -> Spread:
        """The map of the observations, with factors of 1."""
        return self.estimator.spread(self.x)

    @torch.no_grad()
    def log_prob(self, factors: Tensor) -> Tensor:
        """Return the log density of each pair with some factors.

        Args:
            factors: Shape ``(S, d)``.

        Returns:
            Shape ``(n, S)``, float64. It is corrected for what is moved out of a
            support that is no box, and not for leakage over the bounds.
        """
        spread = self.spread.with_factors(factors[:, None])
        moved, slope = spread.inverse(self.theta.expand(len(factors), -1, -1))
        log_prob = self.estimator.log_prob_before(moved, self.x).double() + slope
        if self.accept is not None:
            log_prob = log_prob - self._share_inside(factors).log()
        return log_prob.T

    def _share_inside(self, factors: Tensor) -> Tensor:
        """Return the share of draws that stay inside the support, ``(S, n)``."""
        assert self.accept is not None
        shares = []
        for of_one in factors:
            theta = self.spread.with_factors(of_one).forward(self._draws)
            kept = self.accept(theta.flatten(0, 1)).reshape(theta.shape[:2])
            # Half a draw more, so that no share is zero.
            shares.append((kept.double().sum(dim=0) + 0.5) / (len(kept) + 0.5))
        return torch.stack(shares)

    @cached_property
    def _draws(self) -> Tensor:
        return self.estimator.sample(torch.Size((NUM_DRAWS,)), self.x)

    @torch.no_grad()
    def levels(self, factors: Tensor) -> Tensor:
        """Return the level of the central interval that ends at each parameter.

        Args:
            factors: Shape ``(d,)``.

        Returns:
            Shape ``(n, d)``.
        """
        estimator = self.estimator.with_factors(factors)
        draws = estimator.sample(torch.Size((NUM_DRAWS,)), self.x, accept=self.accept)
        return central_levels(count_ranks(draws, self.theta))


@dataclass(frozen=True)
class Choice:
    """A place on the grids: the numbers of c and of the delta of each parameter."""

    common: int
    own: tuple[int, ...]

    @property
    def factors(self) -> Tensor:
        """The factor of each parameter, shape ``(d,)``."""
        return (COMMON[self.common] + OWN[list(self.own)]).exp()


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutGrid:
    """The log densities of held-out pairs on the grids.

    Attributes:
        common: With one factor for all parameters, shape ``(n, 49)``.
        own: What a factor of one parameter adds, shape ``(n, d, 25)``.
        weights: How many pairs each pair counts as, shape ``(n,)``.
        says_something: Whether the density of a pair is above zero, shape ``(n,)``.
            The others say nothing about the spread, and have zeros.
    """

    common: Tensor
    own: Tensor
    weights: Tensor
    says_something: Tensor

    @classmethod
    def of(cls, folds: Sequence[HeldOutMixture], weights: Tensor) -> "HeldOutGrid":
        """Compute the densities, fold by fold.

        Args:
            folds: The mixture of each fold, with the pairs of the fold.
            weights: How many pairs each pair counts as, in the order of the folds.
        """
        d = folds[0].theta.shape[1]
        device = folds[0].theta.device
        ones = torch.ones(d, dtype=torch.double, device=device)
        factors = COMMON.to(device).exp()[:, None] * ones
        common = torch.cat([fold.log_prob(factors) for fold in folds])
        says_something = torch.isfinite(common[:, [len(COMMON) // 2]])
        common = common.where(says_something, 0.0)
        best = factors[_best_common(common, weights)]
        own = []
        for j in range(d):
            of_one = best.repeat(len(OWN), 1)
            of_one[:, j] *= OWN.to(device).exp()
            own.append(torch.cat([fold.log_prob(of_one) for fold in folds]))
            own[-1] = own[-1].where(says_something, 0.0)
        grid = torch.stack(own, dim=1)
        middle = len(OWN) // 2
        return cls(
            common=common,
            own=grid - grid[..., [middle]],
            weights=weights,
            says_something=says_something[:, 0],
        )

    def best(self, rows: Tensor) -> Choice:
        """Return the best factors for some of the pairs, given by a mask ``(n,)``."""
        weights = self.weights[rows]
        added = torch.einsum("n,ndk->dk", weights, self.own[rows])
        added = added - 0.5 * (OWN.to(added) / OWN_STD).square()
        return Choice(
            _best_common(self.common[rows], weights),
            tuple(added.argmax(dim=1).tolist()),
        )

    @property
    def unchanged(self) -> Tensor:
        """The log density of each pair with factors of 1, shape ``(n,)``."""
        return self.common[:, len(COMMON) // 2]


def _best_common(log_prob: Tensor, weights: Tensor) -> int:
    penalty = 0.5 * (COMMON.to(log_prob) / COMMON_STD).square()
    return int((weights @ log_prob - penalty).argmax())
