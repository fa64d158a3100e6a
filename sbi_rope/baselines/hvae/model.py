r"""The generative model of the HVAE, its approximate posterior, and the ELBO."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sbi_rope.baselines.hvae.prior import ContinuedPrior
from sbi_rope.baselines.hvae.reparametrisation import reparametrised_sample

__all__ = ["FrozenNPE", "HybridVAE", "drawn", "latent_kl", "normal_log_prob"]


class FrozenNPE(NamedTuple):
    """A trained NPE in two halves that are not trained any further.

    Attributes:
        embedding: h, from simulations ``(n, *event)`` to embeddings ``(n, l)``.
        flow: q(theta | h), conditioned on embeddings.
    """

    embedding: nn.Module
    flow: Any


class HybridVAE(nn.Module):
    r"""Real observations as physics seen through a network with a latent vector.

    The model is :math:`\theta \sim p(\theta)`, :math:`z \sim \mathcal{N}(0, I)` and
    :math:`x_o \sim \mathcal{N}(\mu, \operatorname{diag} e^{v})` with
    :math:`\mu, v = \mathrm{P2R}(f(\theta), z)`, where f is deterministic physics. Its
    approximate posterior is

    .. math::
        z \sim q(z \mid x_o), \quad \tilde x_s \sim \mathrm{R2P}(x_o, z), \quad
        \theta \sim q(\theta \mid h(\tilde x_s)),

    the last one a frozen NPE. A draw of :math:`\tilde x_s` is not a variable of the
    model: leaving it out of the bound gives up the information it has on theta, and
    what is left is still a bound.

    Args:
        encoder: From x_o to mean and log-variance of z.
        reality_to_physics: R2P, from (x_o, z) to mean and log-variance.
        physics_to_reality: P2R, likewise.
        npe: The frozen NPE.
        physics: f, from theta ``(n, d)`` to ``(n, *event)``, differentiable.
        prior: p(theta).
        noisy: Whether R2P is drawn from; otherwise its mean is taken.
    """

    def __init__(
        self,
        encoder: nn.Module,
        reality_to_physics: nn.Module,
        physics_to_reality: nn.Module,
        *,
        npe: FrozenNPE,
        physics: Callable[[Tensor], Tensor],
        prior: ContinuedPrior,
        noisy: bool = True,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.reality_to_physics = reality_to_physics
        self.physics_to_reality = physics_to_reality
        # A tuple is not a submodule: neither optimisers nor train() get to it.
        self.npe = npe
        self.physics = physics
        self.prior = prior
        self.noisy = noisy

    def infer(self, x_o: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw z and the embeddings of simulations like x_o.

        Returns:
            Latents ``(n, l_z)``, the KL divergence of their law from the standard
            normal ``(n,)``, and embeddings ``(n, l)``.
        """
        mean, log_variance = self.encoder(x_o)
        z = drawn(mean, log_variance)
        x_s, x_log_variance = self.reality_to_physics(x_o, z)
        if self.noisy:
            x_s = drawn(x_s, x_log_variance)
        return z, latent_kl(mean, log_variance), self.npe.embedding(x_s)

    def elbo(self, x_o: Tensor) -> Tensor:
        """Return an estimate of the ELBO from one draw each, ``(n,)``, in nats."""
        z, kl, s = self.infer(x_o)
        theta = reparametrised_sample(self.npe.flow, s)
        log_q = self.npe.flow.log_prob(theta[None], s)[0]
        simulated = self.physics(self.prior.nearest(theta))
        mean, log_variance = self.physics_to_reality(simulated, z)
        log_likelihood = normal_log_prob(x_o, mean, log_variance)
        return log_likelihood - kl - log_q + self.prior.log_prob(theta)

    def calibration_log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return log q(theta | h(x_s)) with one draw of z each, ``(n,)``."""
        _, _, s = self.infer(x)
        return self.npe.flow.log_prob(theta[None], s)[0]

    def objective(
        self, x_o: Tensor, theta: Tensor, x: Tensor, *, weight: float = 1.0
    ) -> Tensor:
        """Return what is minimised, a scalar.

        Args:
            x_o: Observations without parameters, shape ``(n, *event)``.
            theta: Parameters of calibration pairs, shape ``(m, d)``.
            x: Their observations, shape ``(m, *event)``.
            weight: Of the calibration pairs' mean log-probability.
        """
        log_prob = self.calibration_log_prob(theta, x)
        return -self.elbo(x_o).mean() - weight * log_prob.mean()


def drawn(mean: Tensor, log_variance: Tensor, noise: Tensor | None = None) -> Tensor:
    """Return mean plus standard deviation times noise, standard normal if None."""
    noise = torch.randn_like(mean) if noise is None else noise
    return mean + (0.5 * log_variance).exp() * noise


def latent_kl(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return the divergence of diagonal Gaussians from the standard normal, ``(n,)``.

    Example:
        >>> latent_kl(torch.tensor([[2.0, 0.0]]), torch.zeros(1, 2))
        tensor([2.])
    """
    return 0.5 * (mean**2 + log_variance.exp() - 1 - log_variance).sum(dim=1)


def normal_log_prob(x: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return the log density of events under diagonal Gaussians, ``(n,)``."""
    z_squared = (x - mean) ** 2 * (-log_variance).exp()
    log_density = -0.5 * (z_squared + log_variance + math.log(2 * math.pi))
    return log_density.flatten(1).sum(dim=1)
