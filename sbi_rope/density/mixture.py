"""Mixtures of densities, such as a stack."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.density.base import Density
from sbi_rope.density.flow import Flow
from sbi_rope.density.posterior import MixturePosterior
from sbi_rope.npe.sbi import check_density, estimator_of


class Mixture(Density):
    r"""A weighted sum of densities.

    .. math:: \sum_k w_k\, q_k(\theta \mid x)

    Args:
        parts: :math:`q_k`, all with the same shapes of theta and x.
        weights: :math:`w_k`, with a sum of one. A part of weight zero is left out.
    """

    weights: Tensor

    def __init__(
        self, parts: Sequence[Density], weights: Sequence[float] | Tensor
    ) -> None:
        super().__init__(parts[0].input_shape, parts[0].condition_shape)
        shares = torch.as_tensor(weights, dtype=torch.double)
        used = shares.nonzero().flatten().tolist()
        self.parts: Any = nn.ModuleList(parts[k] for k in used)
        self.register_buffer("weights", shares[used].to(parts[0].device))

    def embed(self, x: Tensor) -> list[Any]:
        """Return what each part keeps of observations."""
        return [part.embed(x) for part in self.parts]

    def log_q(self, theta: Tensor, z: list[Any]) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        parts = zip(self.parts, z, strict=True)
        log_q = torch.stack([part.log_q(theta, own) for part, own in parts], dim=-1)
        return (log_q + self.weights.log()).logsumexp(dim=-1)

    @torch.no_grad()
    def draw(self, z: list[Any], row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        uniform = torch.rand(len(row), dtype=torch.double)
        chosen = torch.searchsorted(self.weights.cpu().cumsum(0), uniform)
        chosen = chosen.clamp_max(len(z) - 1).to(row.device)
        theta = torch.empty(len(row), *self.input_shape, device=row.device)
        for k, (part, own) in enumerate(zip(self.parts, z, strict=True)):
            mine = (chosen == k).nonzero().flatten()
            if len(mine):
                theta[mine] = part.draw(own, row[mine])
        return theta

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations can be embedded by all parts."""
        return torch.stack([part.readable(x) for part in self.parts]).all(dim=0)


def density_of(posterior: Any, *, what: str = "a posterior") -> Density:
    """Return a copy of the density of a posterior, of this package or of NPE."""
    if isinstance(posterior, MixturePosterior):
        return copy.deepcopy(posterior.posterior_estimator)
    return Flow.of([check_density(estimator_of(posterior), what=what)])
