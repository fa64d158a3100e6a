r"""What the posterior of the HVAE is mixed over: draws of the latent vector."""

import torch
from torch import Tensor

from sbi_rope.baselines.hvae.model import HybridVAE, drawn
from sbi_rope.mixture import Mixing, Rows, equal_rows

__all__ = ["LatentEmbeddings"]

# Most entries of series or images that the U-Net sees at a time.
MAX_ENTRIES = 2**18


class LatentEmbeddings(Mixing):
    r"""Embeddings of simulations like an observation, from S draws of the latent.

    .. math::
        s_k(x_o) = h(\tilde x_k), \quad
        \tilde x_k = \mu(x_o, z_k) + \sigma(x_o, z_k) \, \eta_k, \quad
        z_k = m(x_o) + \sigma(x_o) \, \epsilon_k

    All have equal weights. The noise is drawn once and is the same for all
    observations, so that a density mixed over them is a function of theta and x_o.

    Args:
        model: The model, whose networks are shared.
        z_noise: :math:`\epsilon`, shape ``(S, l_z)``.
        x_noise: :math:`\eta`, shape ``(S, *event)``; zero if None.
        event_shape: Shape of one observation.
    """

    z_noise: Tensor
    x_noise: Tensor | None

    def __init__(
        self,
        model: HybridVAE,
        z_noise: Tensor,
        x_noise: Tensor | None,
        event_shape: torch.Size,
    ) -> None:
        super().__init__(event_shape, len(z_noise))
        self.encoder = model.encoder
        self.reality_to_physics = model.reality_to_physics
        self.embedding = model.npe.embedding
        self.register_buffer("z_noise", z_noise)
        self.register_buffer("x_noise", x_noise)

    def rows(self, embedded: Tensor) -> Rows:
        """Weigh all draws equally."""
        return equal_rows(embedded)

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings, ``(n, *event)`` to ``(n, S, l)``."""
        size = self.event_shape.numel()
        draws = torch.arange(self.num_embeddings, device=self.z_noise.device)
        num_rows = max(1, MAX_ENTRIES // (size * len(draws)))
        num_draws = max(1, MAX_ENTRIES // size)
        return torch.cat(
            [
                torch.cat(
                    [self._block(rows, some) for some in draws.split(num_draws)], dim=1
                )
                for rows in x.split(num_rows)
            ]
        )

    def _block(self, x_o: Tensor, draws: Tensor) -> Tensor:
        """Return the embeddings of some draws, ``(b, s, l)``."""
        mean, log_variance = (moment[:, None] for moment in self.encoder(x_o))
        z = drawn(mean, log_variance, self.z_noise[draws]).flatten(0, 1)
        x_s, log_variance = self.reality_to_physics(x_o, z)
        if self.x_noise is not None:
            noise = self.x_noise[draws]
            noise = noise.expand(len(x_o), *noise.shape)
            x_s = drawn(x_s, log_variance, noise.flatten(0, 1))
        return self.embedding(x_s).unflatten(0, (len(x_o), len(draws)))
