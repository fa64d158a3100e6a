"""What RoPE needs of simulations, wherever they come from."""

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from sbi_rope._simulations.moments import Moments

__all__ = ["Embedding", "Readable", "SimulationSource", "all_finite"]

Embedding = Callable[[Tensor], Tensor]
# Tells which simulations an embedding net can read, ``(n, *event)`` to ``(n,)``.
Readable = Callable[[Tensor], Tensor]


def all_finite(x: Tensor) -> Tensor:
    """Tell which rows are finite, which is what most embedding nets can read."""
    return torch.isfinite(x).flatten(1).all(dim=1)


class SimulationSource(Protocol):
    """What RoPE needs of simulations. Each is reduced to its embedding at once."""

    @property
    def num_dropped(self) -> int:
        """How many simulations were dropped so far because of NaN or Inf."""
        ...

    @property
    def num_calls(self) -> int:
        """How many rows a simulator has simulated so far."""
        ...

    @property
    def x_columns(self) -> tuple[str, ...]:
        """The names of the columns of the tables that a simulator returns, if any."""
        ...

    def add_counts(self, num_calls: int, num_dropped: int) -> None:
        """Count what a copy of this source has simulated in another process."""
        ...

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Return parameters from the prior, and the embedding of one simulation each.

        Args:
            count: The number of simulations.
            at_least: The number of simulations if ``count`` is None.
            embed: The embedding h.
            progress: Whether to show the progress of slow simulations.

        Returns:
            theta of shape ``(n_s, d)`` and embeddings of shape ``(n_s, l)``.
        """
        ...

    def targets(
        self,
        theta: Tensor,
        embed: Embedding,
        *,
        simulations_per_target: int,
        num_neighbors: int,
        progress: bool,
    ) -> Tensor:
        """Return the mean embedding of simulations at each theta, ``(n, l)``.

        A simulator makes ``simulations_per_target`` simulations at each theta. Of
        stored simulations, those with the ``num_neighbors`` nearest parameters count.
        """
        ...

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Return mean and covariance of the embedding of simulations at each theta."""
        ...

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Return embeddings of simulations at each theta, ``(n, count, l)``.

        Of stored simulations, those with the nearest parameters count, at most ten.
        """
        ...

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate once at each of several parameters of each pair.

        Args:
            theta: Parameters, shape ``(n, R, d)``.
            embed: The representation of simulations that is returned.
            progress: Whether to show the progress of slow simulations.

        Returns:
            The parameters, shape ``(n, R, d)``, and the embeddings, ``(n, R, l)``.
        """
        ...

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return up to ``count`` pairs (theta, x) from the prior, always the same."""
        ...
