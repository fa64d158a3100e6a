"""Candidates that have a density of the observation itself."""

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    embed,
    embedding_of,
    headless,
)
from sbi_rope.baselines import PriorPosterior
from sbi_rope.mixture.chunks import flow_slices
from sbi_rope.mixture.estimator import without_nan
from sbi_rope.mixture.sampling import Accept

__all__ = [
    "Direct",
    "Part",
    "PriorDensity",
    "log_prob_of_pairs",
    "share_inside",
]


class Direct(nn.Module):
    r"""A density :math:`q(\theta \mid s(x))` of the observation itself.

    Args:
        estimator: An estimator conditioned on x.
    """

    def __init__(self, estimator: ConditionalDensityEstimator) -> None:
        super().__init__()
        self.net = embedding_of(estimator)
        self.density = headless(estimator)

    def features(self, x: Tensor) -> Tensor:
        """Embed observations, ``(n, *event)`` to ``(n, l)``."""
        return embed(self.net, x)

    def log_prob(self, theta: Tensor, features: Tensor) -> Tensor:
        """Return the log densities of pairs, ``(n, d)`` and ``(n, l)`` to ``(n,)``."""
        return self.density.log_prob(theta[None], features)[0]

    def sample(self, features: Tensor) -> Tensor:
        """Draw once for each row, ``(n, l)`` to ``(n, d)``."""
        return self.density.sample(torch.Size((1,)), features)[0]


class PriorDensity(nn.Module):
    """The prior, which ignores the observation."""

    def __init__(self, prior: Distribution) -> None:
        super().__init__()
        self.posterior = PriorPosterior(prior)

    def features(self, x: Tensor) -> Tensor:
        """Return nothing for each observation, ``(n, 0)``."""
        return x.new_empty(len(x), 0)

    def log_prob(self, theta: Tensor, features: Tensor) -> Tensor:
        """Return the log densities, ``(n, d)`` to ``(n,)``."""
        with seeded(0):  # it draws what it evaluates outside the support
            return self.posterior.log_prob(
                theta, track_gradients=torch.is_grad_enabled()
            )

    def sample(self, features: Tensor) -> Tensor:
        """Draw once for each row, ``(n, d)``."""
        return self.posterior.sample((len(features),)).to(features)

    def to_device(self, device: str | torch.device) -> None:
        """Move the prior."""
        self.posterior.to(device)


Part = Direct | PriorDensity


def log_prob_of_pairs(
    part: Part, theta: Tensor, features: Tensor, row: Tensor
) -> Tensor:
    """Return the log densities of theta ``(n, d)`` given the features of their rows."""
    log_q = [
        part.log_prob(theta[block], features[row[block]])
        for block in flow_slices(len(theta), theta.device)
    ]
    return without_nan(torch.cat(log_q))


@torch.no_grad()
def share_inside(part: Part, features: Tensor, accept: Accept, draws: int) -> Tensor:
    """Return the share of draws that is accepted, for each row of features."""
    inside = []
    for row in features:
        # The same random numbers for each, whatever is asked for beside it.
        with seeded(0):
            inside.append(accept(part.sample(row.expand(draws, -1))).double().mean())
    return torch.stack(inside)
