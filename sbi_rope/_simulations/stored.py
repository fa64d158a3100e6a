"""A set of pairs (theta, x) that were simulated beforehand."""

from typing import Any

import torch
from scipy.stats import ks_2samp
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._simulations.moments import Moments
from sbi_rope._simulations.source import Embedding, Readable, all_finite
from sbi_rope._units import divisors
from sbi_rope._validation import check_not_swapped
from sbi_rope.errors import (
    InvalidInputError,
    SimulationError,
    warn_user,
)
from sbi_rope.tensors import as_batch, as_numbers, check_in_support, check_same_length

__all__ = ["StoredSimulations"]

# The number of stored simulations around a theta from which its moments are estimated.
NUM_AROUND = 50
# The number of stored simulations that count as simulations at a theta.
NUM_NEAR = 10
# Draws of the prior that stored parameters are compared with, and the p-value below
# which a warning says that they differ.
NUM_FROM_PRIOR, NOT_FROM_PRIOR = 10_000, 1e-6
# So many distances are computed at once.
MAX_DISTANCES = 50_000_000


class StoredSimulations:
    """Pairs (theta, x) simulated beforehand; pairs that are not finite are dropped.

    Pairs with an x that has missing entries (NaN) are kept if it is ``readable``. Those
    that are known to be ``from_prior`` are not compared with it: without those that
    failed they may not look like it.
    """

    num_calls = 0
    x_columns = ()  # those of tables are read where the tables are passed

    def __init__(
        self,
        simulations: tuple[Tensor, Tensor],
        prior: Distribution,
        *,
        theta_shape: torch.Size,
        event_shape: torch.Size,
        like: Tensor,
        readable: Readable = all_finite,
        from_prior: bool = False,
    ) -> None:
        if not isinstance(simulations, tuple | list) or len(simulations) != 2:
            raise InvalidInputError(
                "Expected `simulations` to be a pair (theta, x) of tensors; got "
                f"{type(simulations).__name__}."
            )
        theta, x = simulations
        check_not_swapped(theta, x, theta_shape, event_shape)
        theta = as_numbers("simulations[0]", theta, device=like.device)
        x = as_numbers("simulations[1]", x, device=like.device)
        theta = as_batch("simulations[0]", theta, theta_shape, finite=False)
        x = as_batch("simulations[1]", x, event_shape, finite=False)
        check_same_length("simulations[0]", theta, "simulations[1]", x)
        theta, x = theta.detach().to(like), x.detach().to(like)
        valid = torch.isfinite(theta).all(dim=1)
        valid &= readable(x)
        if not valid.any():
            raise SimulationError("All stored simulations contain NaN or Inf.")
        _warn_of_dropped(int((~valid).sum()), len(valid), "stored simulations")
        check_in_support("simulations[0]", theta[valid], prior)
        if not from_prior:
            _warn_if_not_from_prior(theta[valid], prior)
        self.num_dropped = int((~valid).sum())
        self.theta, self.x = theta[valid], x[valid]
        # Distances between parameters are in standard deviations of the stored ones.
        # The mean is subtracted, because float32 cannot tell numbers far from zero
        # apart.
        self._theta_mean = self.theta.mean(dim=0)
        self._theta_std = divisors(self.theta.double().std(dim=0)).to(self.theta)

    def add_counts(self, num_calls: int, num_dropped: int) -> None:
        """Do nothing, because nothing is simulated."""

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed a random subset; without a count, up to ``at_least`` of them."""
        available = len(self.x)
        if count is not None and count > available:
            raise InvalidInputError(
                f"Expected `num_simulations` of at most {available}, the number of "
                f"stored simulations; got {count}."
            )
        count = min(available, at_least) if count is None else count
        chosen = torch.randperm(available)[:count].to(self.x.device)
        return self.theta[chosen], embed(self.x[chosen])

    def targets(
        self,
        theta: Tensor,
        embed: Embedding,
        *,
        simulations_per_target: int,
        num_neighbors: int,
        progress: bool,
    ) -> Tensor:
        """Average over the stored simulations with the nearest parameters."""
        if num_neighbors > len(self.x):
            raise InvalidInputError(
                f"Expected `num_neighbors` of at most {len(self.x)}, the number of "
                f"stored simulations; got {num_neighbors}."
            )
        nearest = self._nearest(theta, num_neighbors)
        embedded = embed(self.x[nearest.flatten()])
        return embedded.reshape(*nearest.shape, -1).mean(dim=1)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Fit a plane to the embeddings of the stored simulations around each theta.

        The mean is the height of the plane at theta, and the covariance is that of the
        residuals. ``count`` has no effect: the number of stored simulations around a
        theta depends on the number of parameters.
        """
        number = min(len(self.x), max(NUM_AROUND, 5 * (theta.shape[1] + 1)))
        nearest = self._nearest(theta, number)
        embedded = embed(self.x[nearest.flatten()]).double()
        embedded = embedded.reshape(*nearest.shape, -1)
        offsets = self._standardised(self.theta[nearest]).double()
        offsets = offsets - self._standardised(theta).double()[:, None]
        # The ridge keeps the plane level if the parameters around theta do not vary.
        design = torch.cat([torch.ones_like(offsets[..., :1]), offsets], dim=-1)
        ridge = torch.full((design.shape[-1],), 1e-6).to(design)
        ridge[0] = 0.0
        normal = design.mT @ design + ridge.diag()
        plane = torch.linalg.solve(normal, design.mT @ embedded)
        left_over = embedded - design @ plane
        freedom = max(1, number - design.shape[-1])
        return Moments(mean=plane[:, 0], covariance=left_over.mT @ left_over / freedom)

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Embed the stored simulations with the nearest parameters."""
        nearest = self._nearest(theta, min(count, NUM_NEAR, len(self.x)))
        embedded = embed(self.x[nearest.flatten()])
        return embedded.reshape(*nearest.shape, -1)

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed the stored simulation with the nearest parameters."""
        embedded = self.draws(theta.flatten(0, 1), 1, embed, progress=progress)
        return theta, embedded.reshape(*theta.shape[:2], -1)

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return stored pairs, chosen at random because they may be sorted."""
        with seeded(0):
            chosen = torch.randperm(len(self.x))[:count].to(self.x.device)
        return self.theta[chosen], self.x[chosen]

    def _nearest(self, theta: Tensor, count: int) -> Tensor:
        """Return the rows with the nearest parameters, shape ``(n, count)``."""
        stored, wanted = self._standardised(self.theta), self._standardised(theta)
        # Imperfect labels have many possible parameters each, too many for one matrix.
        nearest = [
            torch.cdist(some, stored).topk(count, dim=1, largest=False).indices
            for some in wanted.split(max(1, MAX_DISTANCES // len(stored)))
        ]
        return torch.cat(nearest)

    def _standardised(self, theta: Tensor) -> Tensor:
        return (theta - self._theta_mean) / self._theta_std


def _warn_if_not_from_prior(theta: Tensor, prior: Distribution) -> None:
    """Compare each stored parameter with draws of the prior."""
    with seeded(0):
        drawn = prior.sample(torch.Size((NUM_FROM_PRIOR,)))
    p_values = []
    for stored, of_prior in zip(theta.T.cpu(), drawn.T.cpu(), strict=True):
        test: Any = ks_2samp(stored.numpy(), of_prior.numpy(), method="asymp")
        p_values.append(float(test.pvalue))
    unlike = [k for k, p_value in enumerate(p_values) if p_value < NOT_FROM_PRIOR]
    if unlike:
        warn_user(
            f"The parameters {unlike} of `simulations` (counted from 0) are not "
            "distributed like the prior (p = "
            f"{min(p_values):.0e} in a Kolmogorov-Smirnov test). They are taken for "
            "draws of the prior, so that posteriors will prefer parameters of which "
            "there are many. Pass simulations at draws of the prior, or train NPE with "
            "the prior that these were drawn from."
        )


def _warn_of_dropped(dropped: int, total: int, what: str) -> None:
    """Warn if simulations were dropped."""
    if dropped:
        warn_user(
            f"Dropped {dropped} of {total} {what} because they contain NaN or Inf."
        )
