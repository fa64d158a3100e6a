"""Couplings of one batch at several settings, as one coupling."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.coupling import Coupling
from sbi_rope.mixture.chunks import blocks

__all__ = ["StackedCoupling", "StackedEmbedding"]


class StackedEmbedding(nn.Module):
    """Several embeddings of an observation, one after the other in one vector."""

    def __init__(self, nets: Sequence[nn.Module]) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(n, *event)`` to ``(n, l_1 + l_2 + ...)``."""
        return torch.cat([net(x) for net in self.nets], dim=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class StackedCoupling:
    r"""Couplings of one batch with the same simulations, as one coupling.

    Row i is :math:`\sum_k w_k \alpha^{(k)}_i`: the mixtures of all couplings have the
    same components, so that their mixture needs one evaluation of each.

    Attributes:
        couplings: The couplings, K of them.
        shares: Their weights w, which sum to one, shape ``(K,)``.
        real: The embeddings of the batch, one after the other, shape ``(n_o, L)``.
        columns: For each coupling the columns of ``real`` that it was made from.
    """

    couplings: tuple[Coupling, ...]
    shares: Tensor
    real: Tensor
    columns: tuple[slice, ...]

    @property
    def weights(self) -> Tensor:
        """The rows of the batch, shape ``(n_o, n_s)``; computed at every request."""
        return self.rows(self.real)

    @property
    def simulated(self) -> Tensor:
        """The embeddings of the simulations, shape ``(n_s, l)``."""
        return self.couplings[0].simulated

    @property
    def converged(self) -> bool:
        """Whether all couplings have converged."""
        return all(coupling.converged for coupling in self.couplings)

    @property
    def effective_sample_size(self) -> Tensor:
        r""":math:`1 / \sum_j \alpha_{ij}^2` of each row, shape ``(n_o,)``."""
        sizes = [
            1 / self.rows(self.real[block]).square().sum(dim=1)
            for block in blocks(len(self.real), len(self.simulated))
        ]
        return torch.cat(sizes)

    def rows(self, features: Tensor) -> Tensor:
        """Return the weights of the components, ``(n, L)`` to ``(n, n_s)``."""
        total: Any = 0.0
        for share, rows in zip(
            self.shares.tolist(), self.rows_of_each(features), strict=True
        ):
            total = total + share * rows
        return total

    def rows_of_each(self, features: Tensor) -> Iterator[Tensor]:
        """Yield the rows of one coupling after the other, ``(n, n_s)`` each."""
        for coupling, columns in zip(self.couplings, self.columns, strict=True):
            yield coupling.rows(features[:, columns])

    def to(self, device: str | torch.device) -> "StackedCoupling":
        """Return a copy on a device."""
        return replace(
            self,
            couplings=tuple(coupling.to(device) for coupling in self.couplings),
            shares=self.shares.to(device),
            real=self.real.to(device),
        )
