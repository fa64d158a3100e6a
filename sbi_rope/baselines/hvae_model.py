r"""The generative model of the HVAE, its approximate posterior, and the ELBO."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._prior import PriorDistribution
from sbi_rope.baselines.networks import bounded, embedding_with_head

__all__ = ["ContinuedPrior", "HybridVAE", "LatentEncoder", "drawn"]

# Length over which the continued density falls by a factor of e, and how far inside
# its ends the support is cut, in standard deviations of the prior. Some densities, that
# of the light tunnel's polarisers for one, are infinite at the ends.
FLANK, MARGIN = 0.1, 1e-3


class HybridVAE(nn.Module):
    r"""Real observations as physics seen through a network with a latent vector.

    The model is :math:`\theta \sim p(\theta)`, :math:`z \sim \mathcal{N}(0, I)` and
    :math:`x_o \sim \mathcal{N}(\mu, \operatorname{diag} e^{v})` with
    :math:`\mu, v = \mathrm{P2R}(f(\theta), z)`, where f is deterministic physics. Its
    approximate posterior is

    .. math::
        z \sim q(z \mid x_o), \quad \theta \sim q(\theta \mid h(\tilde x_s)), \quad
        \tilde x_s = \mathrm{R2P}(x_o, z),

    the second one a frozen NPE. Each network returns a mean and a log-variance; that of
    R2P has no use. The physics maps theta ``(n, d)`` to ``(n, *event)``.
    """

    def __init__(
        self,
        encoder: nn.Module,
        reality_to_physics: nn.Module,
        physics_to_reality: nn.Module,
        *,
        npe: tuple[nn.Module, Any],
        physics: Callable[[Tensor], Tensor],
        prior: "ContinuedPrior",
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.reality_to_physics = reality_to_physics
        self.physics_to_reality = physics_to_reality
        # A tuple is not a submodule: neither optimisers nor train() get to it.
        self.npe = npe
        self.physics = physics
        self.prior = prior

    def _infer(self, x_o: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw z, and return its divergence from the prior and h of a simulation."""
        mean, log_variance = self.encoder(x_o)
        z = drawn(mean, log_variance, torch.randn_like(mean))
        kl = 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum(dim=1)
        x_s, _ = self.reality_to_physics(x_o, z)
        return z, kl, self.npe[0](x_s)

    def elbo(self, x_o: Tensor) -> Tensor:
        """Return an estimate of the ELBO from one draw each, ``(n,)``, in nats."""
        flow = self.npe[1]
        z, kl, s = self._infer(x_o)
        theta = reparametrised_sample(flow, s)
        log_q = flow.log_prob(theta[None], s)[0]
        simulated = self.physics(self.prior.nearest(theta))
        mean, log_variance = self.physics_to_reality(simulated, z)
        z_squared = (x_o - mean) ** 2 * (-log_variance).exp()
        log_density = -0.5 * (z_squared + log_variance + math.log(2 * math.pi))
        log_likelihood = log_density.flatten(1).sum(dim=1)
        return log_likelihood - kl - log_q + self.prior.log_prob(theta)

    def calibration_log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return log q(theta | h(x_s)) with one draw of z each, ``(n,)``."""
        _, _, s = self._infer(x)
        return self.npe[1].log_prob(theta[None], s)[0]

    def objective(self, x_o: Tensor, theta: Tensor, x: Tensor) -> Tensor:
        """Return what is minimised: pairs weigh like all entries of an observation.

        Observations x_o are ``(n, *event)``; pairs, ``(m, d)`` and ``(m, *event)``.
        """
        log_prob = self.calibration_log_prob(theta, x)
        return -self.elbo(x_o).mean() - x_o[0].numel() * log_prob.mean()


class LatentEncoder(nn.Module):
    """A diagonal Gaussian over latent vectors, predicted from an observation.

    A copy of an embedding net that starts anew, and a linear layer for mean and
    log-variance; some observations ``(n, *event)`` tell the width of an embedding.
    """

    def __init__(self, embedding: nn.Module, latent_dim: int, x: Tensor) -> None:
        super().__init__()
        self.net = embedding_with_head(embedding, 2 * latent_dim, x)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance, each ``(n, latent_dim)``."""
        mean, log_variance = self.net(x).chunk(2, dim=1)
        return mean, bounded(log_variance)


def drawn(mean: Tensor, log_variance: Tensor, noise: Tensor) -> Tensor:
    """Return mean plus standard deviation times noise."""
    return mean + (0.5 * log_variance).exp() * noise


class ContinuedPrior:
    r"""A prior on a box whose density falls off outside of it instead of ending.

    With :math:`\bar\theta` the nearest point in the box and :math:`s` the standard
    deviations of the prior,

    .. math::
        \log \tilde p(\theta) = \log p(\bar\theta)
        - \sum_k \frac{|\theta_k - \bar\theta_k|}{0.1\, s_k}.

    A flow puts some of its mass outside of the support. There the ELBO would be minus
    infinity and without a gradient; this one is finite and leads back inside.
    """

    def __init__(self, prior: Distribution) -> None:
        self._prior = PriorDistribution(prior)
        self.std = self._prior.stddev
        low, high = self._prior.bounds(self.std)
        self.low, self.high = low + MARGIN * self.std, high - MARGIN * self.std

    def nearest(self, theta: Tensor) -> Tensor:
        """Return the nearest points in the box, ``(n, d)``."""
        return theta.clamp(self.low, self.high)

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the continued log density, ``(n, d)`` to ``(n,)``."""
        inside = self.nearest(theta)
        distance = ((theta - inside).abs() / (FLANK * self.std)).sum(dim=1)
        return self._prior.log_prob(inside) - distance


def reparametrised_sample(flow: Any, condition: Tensor) -> Tensor:
    r"""Draw one theta a condition, differentiable with respect to the condition.

    A flow maps theta to noise :math:`u = T(\theta; s)`. At fixed noise the theorem on
    implicit functions gives

    .. math::
        \frac{\partial \theta}{\partial s} = -\left(
        \frac{\partial T}{\partial \theta} \right)^{-1} \frac{\partial T}{\partial s}.

    Only :math:`T` is differentiated, so that flows may be inverted by a search. The
    flow has no embedding net; conditions are ``(n, l)``, and parameters ``(n, d)``.
    """
    with torch.no_grad():
        theta = flow.sample(torch.Size((1,)), condition)[0]
    if not torch.is_grad_enabled():
        return theta
    point = theta.detach().requires_grad_()
    noise = flow.inverse_transform(point, condition)
    rows = [
        torch.autograd.grad(entry.sum(), point, retain_graph=True)[0]
        for entry in noise.unbind(dim=1)
    ]
    jacobian = torch.stack(rows, dim=1)
    # Zero, but for its gradient.
    step = torch.linalg.solve(jacobian, (noise - noise.detach()).unsqueeze(2))
    return theta - step.squeeze(2)
