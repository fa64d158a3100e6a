"""From draws of NPE to parameters, as a density."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.baselines.fmcpe.unbounded import Unbounded
from sbi_rope.baselines.fmcpe.velocity import (
    VelocityField,
    follow,
    follow_back,
    matching_loss,
)
from sbi_rope.density import Density
from sbi_rope.density.posterior import is_unbounded

__all__ = ["PushedForward"]


class PushedForward(ConditionalDensityEstimator):
    r"""A density that a map :math:`T_\theta` carries on.

    What the density has outside the prior's support, the prior takes the place of:

    .. math:: p(\theta_0) = q(\theta_0) + (1 - Z)\, \pi(\theta_0), \qquad
        Z = \int_{\pi > 0} q .

    Args:
        base: The density of :math:`\theta_0` given an observation.
        prior: The prior.
        field: The velocity field of the map.
    """

    def __init__(
        self, base: Density, prior: Distribution, field: VelocityField
    ) -> None:
        super().__init__(nn.Identity(), base.input_shape, base.condition_shape)
        self.base = base
        self.unbounded = Unbounded(prior)
        self.field = field

    def loss(  # type: ignore[override]
        self, x_o: Tensor, start: Tensor, end: Tensor
    ) -> Tensor:
        """Return the loss of flow matching, a mean over all rows.

        Args:
            x_o: Observations, shape ``(n, *event)``.
            start: Draws of the density before the map, shape ``(n, d)``.
            end: What they are to be carried to, transformed, shape ``(n, d)``.
        """
        start = self.unbounded.transformed(start)
        return matching_loss(self.field, start, end, self.field.condition(x_o))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log density, shape ``(S, B)``; -inf outside the support."""
        theta = input if input.ndim == 3 else input[None]
        count, num_rows = theta.shape[0], max(theta.shape[1], len(condition))
        theta = theta.expand(count, num_rows, -1)
        c = self.field.condition(condition)
        c = c.expand(num_rows, -1).repeat(count, 1)
        u, log_scale, inside = self.unbounded.transformed_inside(theta.flatten(0, 1))
        u_start, divergence = follow_back(self.field, u, c)
        start = self.unbounded.inverse(u_start)
        usable = self.unbounded.contains(start)
        base = self._log_prob_at_start(start.reshape(theta.shape), condition)
        rest = log_scale - self.unbounded.log_scale(u_start) - divergence
        log_prob = base + rest.reshape(count, num_rows)
        inside = (inside & usable).reshape(count, num_rows)
        return log_prob.where(inside, -torch.inf)

    def _log_prob_at_start(self, start: Tensor, condition: Tensor) -> Tensor:
        """Return the log density before the map, ``(S, B)``."""
        prior = self.unbounded.prior
        z, num_rows = self.base.embed(condition), len(condition)
        log_q = self.base.log_prob_given(start, z, num_rows).to(start)
        if is_unbounded(prior):
            return log_q
        outside = 1 - self.base.mass(z, num_rows, self.unbounded.contains).mass
        replaced = prior.log_prob(start.flatten(0, 1)).reshape(start.shape[:2])
        return torch.logaddexp(log_q, outside.clamp_min(0).log().to(start) + replaced)

    @torch.no_grad()
    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw parameters, shape ``(*sample_shape, B, d)``."""
        count, num_rows = torch.Size(sample_shape).numel(), len(condition)
        start = self.base.sample(torch.Size((count,)), condition).flatten(0, 1)
        u = self.unbounded.transformed(self.unbounded.replaced(start))
        c = self.field.condition(condition).repeat(count, 1)
        theta = self.unbounded.inverse(follow(self.field, u, c))
        return theta.reshape(*sample_shape, num_rows, -1)
