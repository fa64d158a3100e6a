r"""The importance-weighted bound that error model and posterior are fitted by."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.baselines.rvnp.likelihood import ErrorModel, log_likelihood
from sbi_rope.density.prior import prior_log_prob, prior_sample

__all__ = ["Bound", "Terms"]

# The share of the draws that come from the prior.
SHARE_OF_PRIOR = 0.25


class Terms(NamedTuple):
    r"""What a bound is made of.

    Attributes:
        log_evidence: :math:`\log \hat p(y)` of each observation, shape ``(n,)``.
        cross_entropy: :math:`-\sum_k w_k \log q(\theta_k \mid y)`, shape ``(n,)``.
        squared_shift: The mean of :math:`\lVert \mu(\theta) \rVert^2` over all draws.
    """

    log_evidence: Tensor
    cross_entropy: Tensor
    squared_shift: Tensor


class Bound(nn.Module):
    r"""An estimate of the evidence of real statistics, with weighted draws of theta.

    .. math::
        \log \hat p(y) = \log \tfrac1K \sum_k v_k, \qquad
        v_k = \frac{p(y \mid \theta_k)\, p(\theta_k)}{r(\theta_k)}, \qquad
        r = \tfrac34\, q(\theta \mid y) + \tfrac14\, p(\theta),

    with K draws of r and weights :math:`w_k = v_k / \sum_j v_j`. The mean of the
    logarithm is never above :math:`\log p(y)`.

    Args:
        q: The density of theta given statistics, which is trained.
        errors: The error model, which is trained.
        surrogate: The density of simulated statistics given theta.
        prior: The prior.
        num_draws: K, two or more.
    """

    def __init__(
        self,
        q: Any,
        errors: ErrorModel,
        surrogate: Any,
        prior: Distribution,
        num_draws: int,
    ) -> None:
        super().__init__()
        self.q = q
        self.errors = errors
        self.surrogate = surrogate
        self.prior = prior
        self.num_of_prior = max(1, round(SHARE_OF_PRIOR * num_draws))
        self.num_of_q = num_draws - self.num_of_prior

    def forward(self, statistics: Tensor, y: Tensor) -> Terms:
        """Return the terms of the bound.

        Args:
            statistics: Statistics of observations as q takes them, ``(n, *)``.
            y: The same, standardised, shape ``(n, l)``.
        """
        theta = self._draws(statistics)
        log_q = self.q.log_prob(theta, statistics).double()
        log_prior = prior_log_prob(self.prior, theta).double()
        log_lik, of_mean = log_likelihood(
            self.surrogate, self.errors, y.repeat(len(theta), 1), theta.flatten(0, 1)
        )
        shares = torch.tensor([self.num_of_q, self.num_of_prior]).to(log_q)
        # K times r. The draws are given, so that no gradient passes through it.
        log_r = torch.logaddexp(
            log_q.detach() + shares[0].log(), log_prior + shares[1].log()
        )
        log_v = log_lik.unflatten(0, theta.shape[:2]) + log_prior - log_r
        weights = log_v.detach().softmax(dim=0)
        return Terms(
            log_v.logsumexp(dim=0),
            -(weights * log_q).sum(dim=0),
            of_mean.square().sum(dim=1).mean(),
        )

    @torch.no_grad()
    def _draws(self, statistics: Tensor) -> Tensor:
        """Return draws of r for each observation, ``(K, n, d)``."""
        of_q = self.q.sample(torch.Size((self.num_of_q,)), statistics)
        shape = torch.Size((self.num_of_prior, len(statistics)))
        return torch.cat([of_q, prior_sample(self.prior, shape).to(of_q)])
