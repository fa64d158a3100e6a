r"""The posterior of the HVAE: NPE averaged over draws of the latent vector."""

import torch
from torch import Tensor

from sbi_rope.baselines.hvae.model import HybridVAE, drawn
from sbi_rope.density import Density, Flow
from sbi_rope.ensemble import Ensemble, embedded, log_density

__all__ = ["OverLatents"]

# Most entries of series or images that the U-Net sees at a time.
MAX_ENTRIES = 2**18


class OverLatents(Flow):
    r"""NPE averaged over simulations like an observation, of S draws of the latent.

    .. math::
        \tfrac1S \sum_k q(\theta \mid h(\tilde x_k)), \quad
        \tilde x_k = \mu(x_o, z_k) + \sigma(x_o, z_k) \, \eta_k, \quad
        z_k = m(x_o) + \sigma(x_o) \, \epsilon_k

    The noise is drawn once and is the same for all
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
        flow = model.npe.flow
        super().__init__(
            Ensemble([model.npe.embedding], embedded, ()),
            Ensemble([flow], log_density, ()),
            torch.full((len(z_noise),), 1 / len(z_noise)).double(),
            input_shape=flow.input_shape,
            condition_shape=event_shape,
        )
        self.encoder = model.encoder
        self.reality_to_physics = model.reality_to_physics
        self.register_buffer("z_noise", z_noise)
        self.register_buffer("x_noise", x_noise)

    readable = Density.readable  # what is finite

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings, ``(n, *event)`` to ``(n, S, l)``."""
        size = self.condition_shape.numel()
        draws = torch.arange(self.num_members, device=self.z_noise.device)
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
        z = self.nets.answer(embedded, x_s)
        return z.unflatten(0, (len(x_o), len(draws)))
