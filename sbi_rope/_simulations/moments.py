"""Mean and covariance of simulations at given parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Moments"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Moments:
    """Mean and covariance of the embeddings of simulations at given parameters.

    Attributes:
        mean: Shape ``(n, l)``, float64.
        covariance: Shape ``(n, l, l)``, float64.
        possible: Where labels are not exact, means at R parameters that each of them
            leaves possible, shape ``(n, R, l)``; ``mean`` is their average. None for
            exact labels.
    """

    mean: Tensor
    covariance: Tensor
    possible: Tensor | None = None

    def __getitem__(self, rows: Tensor) -> "Moments":
        return Moments(
            mean=self.mean[rows],
            covariance=self.covariance[rows],
            possible=None if self.possible is None else self.possible[rows],
        )

    @classmethod
    def joined(cls, parts: Sequence["Moments"]) -> "Moments":
        """Return the moments of several sets of parameters, one after the other."""
        possible = [part.possible for part in parts if part.possible is not None]
        return cls(
            mean=torch.cat([part.mean for part in parts]),
            covariance=torch.cat([part.covariance for part in parts]),
            possible=torch.cat(possible) if possible else None,
        )

    def columns(self, columns: slice) -> "Moments":
        """Return the moments of some entries of the embeddings."""
        possible = self.possible
        return Moments(
            mean=self.mean[:, columns],
            covariance=self.covariance[:, columns, columns],
            possible=None if possible is None else possible[..., columns],
        )

    @property
    def means(self) -> Tensor:
        """The possible means, ``(n, R, l)``, or the only ones, ``(n, l)``."""
        return self.mean if self.possible is None else self.possible
