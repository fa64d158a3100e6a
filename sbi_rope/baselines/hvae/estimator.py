r"""The posterior of the HVAE: a mixture over draws of the latent vector."""

import math
from typing import Any

import torch
from torch import Tensor

from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.baselines.hvae.model import HybridVAE, drawn
from sbi_rope.mixture.chunks import flow_batch

__all__ = ["LatentMixture"]

# Most entries of series or images that the U-Net sees at a time.
MAX_ENTRIES = 2**18


class LatentMixture(ConditionalDensityEstimator):
    r"""The density of theta given a real observation, averaged over latent vectors.

    .. math::
        p(\theta \mid x_o) = \frac1S \sum_{s=1}^S q(\theta \mid h(\tilde x_s)), \quad
        z_s = m(x_o) + \sigma(x_o) \, \epsilon_s, \quad
        \tilde x_s = \mu(x_o, z_s) + \sigma(x_o, z_s) \, \eta_s

    The noise is drawn once and is the same for all observations, so that the density is
    a function of theta and x_o. An estimator in the sense of sbi; the prior's support
    is not its business.

    Args:
        model: The model, whose networks are shared.
        z_noise: :math:`\epsilon`, shape ``(S, l_z)``.
        x_noise: :math:`\eta`, shape ``(S, *event)``; zero if None.
        theta_shape: Shape of one theta.
        event_shape: Shape of one observation.
    """

    z_noise: Tensor
    x_noise: Tensor | None

    def __init__(
        self,
        model: HybridVAE,
        z_noise: Tensor,
        x_noise: Tensor | None,
        theta_shape: torch.Size,
        event_shape: torch.Size,
    ) -> None:
        super().__init__(model.encoder, theta_shape, event_shape)
        self.reality_to_physics = model.reality_to_physics
        self.embedding, self.flow = model.npe
        self.register_buffer("z_noise", z_noise)
        self.register_buffer("x_noise", x_noise)

    @torch.no_grad()
    def statistics(self, x_o: Tensor, *, num_latents: int | None = None) -> Tensor:
        """Return the conditions of the components.

        Args:
            x_o: Real observations, shape ``(B, *event)``.
            num_latents: Number of components, the first ones; all S if None.

        Returns:
            Statistics, shape ``(B, S, l)``.
        """
        size = self.condition_shape.numel()
        draws = torch.arange(len(self.z_noise), device=self.z_noise.device)
        draws = draws[:num_latents]
        num_rows = max(1, MAX_ENTRIES // (size * len(draws)))
        num_draws = max(1, MAX_ENTRIES // size)
        return torch.cat(
            [
                torch.cat(
                    [self._block(rows, some) for some in draws.split(num_draws)], dim=1
                )
                for rows in x_o.split(num_rows)
            ]
        )

    def _block(self, x_o: Tensor, draws: Tensor) -> Tensor:
        """Return the statistics of some components, ``(b, s, l)``."""
        mean, log_variance = (moment[:, None] for moment in self.net(x_o))
        z = drawn(mean, log_variance, self.z_noise[draws]).flatten(0, 1)
        x_s, log_variance = self.reality_to_physics(x_o, z)
        if self.x_noise is not None:
            noise = self.x_noise[draws]
            noise = noise.expand(len(x_o), *noise.shape)
            x_s = drawn(x_s, log_variance, noise.flatten(0, 1))
        return self.embedding(x_s).unflatten(0, (len(x_o), len(draws)))

    def log_prob(
        self,
        input: Tensor,
        condition: Tensor,
        *,
        num_latents: int | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return the log density.

        Args:
            input: theta, shape ``(N, B, k)`` or ``(B, k)``; B or 1 of them.
            condition: Real observations, shape ``(B, *event)``; B or 1 of them.
            num_latents: Number of components, the first ones; all S if None.
            **kwargs: None; kept for sbi's signature.

        Returns:
            Shape ``(N, B)``.
        """
        theta = input if input.ndim == 3 else input[None]
        s = self.statistics(condition, num_latents=num_latents)
        num_rows = max(theta.shape[1], len(s))
        theta = theta.expand(-1, num_rows, -1)
        s = s.expand(num_rows, -1, -1)
        step = max(1, flow_batch(s.device) // max(1, len(theta) * s.shape[1]))
        return torch.cat(
            [
                self._mixed(part, statistics)
                for part, statistics in zip(
                    theta.split(step, dim=1), s.split(step), strict=True
                )
            ],
            dim=1,
        )

    def _mixed(self, theta: Tensor, s: Tensor) -> Tensor:
        """Mix at theta ``(N, b, k)`` over statistics ``(b, S, l)``, to ``(N, b)``."""
        num_rows, num_latents, _ = s.shape
        step = max(1, flow_batch(s.device) // (num_rows * num_latents))
        parts = []
        for part in theta.split(step):
            points = part[:, :, None].expand(-1, -1, num_latents, -1).flatten(1, 2)
            log_q = self.flow.log_prob(points, s.flatten(0, 1))
            # A component that cannot be evaluated must not take the others with it.
            log_q = log_q.where(~torch.isnan(log_q), -torch.inf)
            log_q = log_q.unflatten(1, (num_rows, num_latents))
            parts.append(log_q.logsumexp(dim=2) - math.log(num_latents))
        return torch.cat(parts)

    @torch.no_grad()
    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw a component and a theta from it, shape ``(*sample_shape, B, k)``."""
        s = self.statistics(condition)
        num_rows, num_latents, _ = s.shape
        shape = torch.Size(sample_shape)
        row = torch.arange(num_rows, device=s.device).repeat(shape.numel())
        draw = torch.randint(num_latents, row.shape, device=s.device)
        size = flow_batch(s.device)
        theta = [
            self.flow.sample(torch.Size((1,)), s[rows, draws])[0]
            for rows, draws in zip(row.split(size), draw.split(size), strict=True)
        ]
        return torch.cat(theta).reshape(*shape, num_rows, *self.input_shape)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log density, shape ``(B,)``."""
        return -self.log_prob(input, condition)[0]
