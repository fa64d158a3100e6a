"""NPE averaged over simulations with the same parameters as an observation."""

import torch
from torch import Tensor, nn

from sbi_rope._sbi import ConditionalDensityEstimator, embed
from sbi_rope.baselines.fmcpe.standardise import Standardise
from sbi_rope.baselines.fmcpe.velocity import VelocityField, follow, matching_loss
from sbi_rope.density import Density, Flow
from sbi_rope.ensemble import Ensemble, embedded, log_density

__all__ = ["ToSimulations"]

# Most entries of simulations that are made of observations at a time.
MAX_ENTRIES = 2**22


class ToSimulations(Flow):
    r"""NPE averaged over simulations like an observation, of K draws of noise.

    .. math::
        \tfrac1K \sum_k q(\theta \mid s_k), \qquad
        s_k = h\bigl(T_x(x_o + \epsilon\, \xi_k;\, x_o)\bigr)

    Args:
        density: :math:`q(\theta \mid s)`.
        statistics: What is mapped of an observation: itself, or its embedding.
        unit: Standardises what is mapped.
        field: The velocity field of the map.
        then: From what it is mapped to, to the embedding that NPE's density sees.
        event_shape: Shape of one observation.
        noise: :math:`\epsilon`; None leaves the observation out of the start.
        num_draws: K.
    """

    xi: Tensor

    def __init__(
        self,
        density: ConditionalDensityEstimator,
        statistics: nn.Module,
        unit: Standardise,
        field: VelocityField,
        then: nn.Module,
        *,
        event_shape: torch.Size,
        noise: float | None,
        num_draws: int,
    ) -> None:
        super().__init__(
            Ensemble([then], embedded, ()),
            Ensemble([density], log_density, ()),
            torch.full((num_draws,), 1 / num_draws).double(),
            input_shape=density.input_shape,
            condition_shape=event_shape,
        )
        self.statistics = statistics
        self.unit = unit
        self.field = field
        self.noise = noise
        # On the CPU, so that a seed means the same on every device.
        noise_shape = num_draws, len(unit.mean)
        self.register_buffer("xi", torch.randn(noise_shape, device="cpu"))
        blank = unit.mean.new_zeros(1, *event_shape)
        self.shape = embed(statistics, blank).shape[1:]

    def field_loss(self, x_o: Tensor, simulated: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of the field, and the embedding of a simulation like each.

        Args:
            x_o: Observations, shape ``(n, *event)``.
            simulated: A flat simulation with the same parameters, shape ``(n, m)``.
        """
        end, c = self.unit(simulated), self.field.condition(x_o)
        centre, scale = self._start(x_o)
        start, other = (centre + scale * torch.randn_like(end) for _ in range(2))
        loss = matching_loss(self.field, start, end, c)
        with torch.no_grad():
            return loss, self._embedded(follow(self.field, other, c))

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of simulations like observations, ``(n, K, l)``."""
        size = max(1, MAX_ENTRIES // self.xi.numel())
        return torch.cat([self._like(part) for part in x.split(size)])

    def _like(self, x: Tensor) -> Tensor:
        count = self.num_members
        centre, scale = self._start(x)
        start = (centre[:, None] + scale * self.xi).flatten(0, 1)
        c = self.field.condition(x).repeat_interleave(count, dim=0)
        embedded = self._embedded(follow(self.field, start, c))
        return embedded.unflatten(0, (len(x), count))

    def _start(self, x: Tensor) -> tuple[Tensor, float]:
        """Return mean ``(n, m)`` and deviation of where ways to simulations start."""
        flat = self.unit(embed(self.statistics, x).flatten(1))
        if self.noise is None:
            return torch.zeros_like(flat), 1.0
        return flat, self.noise

    readable = Density.readable  # what is finite

    def _embedded(self, z: Tensor) -> Tensor:
        simulated = self.unit.inverse(z).reshape(len(z), *self.shape)
        return super().embed(simulated)[:, 0]
