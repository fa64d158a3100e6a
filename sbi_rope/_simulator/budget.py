"""A simulator that is called a given number of times, and not again."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._simulations import (
    Embedding,
    Moments,
    Readable,
    StoredSimulations,
    all_finite,
)
from sbi_rope._simulator.calls import Simulated

if TYPE_CHECKING:
    from sbi_rope._simulator.source import Simulator

__all__ = ["LimitedSimulator"]


class LimitedSimulator:
    """Simulates at draws of the prior once; all that is asked for is looked up there.

    The simulations are made when they are first needed. If that is interrupted, the
    next call goes on where it was.

    Args:
        simulator: The simulator.
        num_simulations: How many simulations are made.
        prior: The prior.
        event_shape: Shape of one simulation.
        like: Parameters whose shape, dtype and device simulations have to fit.
        readable: As in :class:`Simulator`.
    """

    def __init__(
        self,
        simulator: "Simulator",
        num_simulations: int,
        prior: Distribution,
        *,
        event_shape: torch.Size,
        like: Tensor,
        readable: Readable = all_finite,
    ) -> None:
        self._readable = readable
        self.num_simulations = num_simulations
        self._simulator = simulator
        self._prior = prior
        self._event_shape = event_shape
        self._like = like
        self._finished: list[Simulated] = []
        self._stored: StoredSimulations | None = None

    @property
    def num_dropped(self) -> int:
        """How many simulations were dropped because of NaN or Inf."""
        return self._simulator.num_dropped

    @property
    def num_calls(self) -> int:
        """How many rows the simulator has simulated."""
        return self._simulator.num_calls

    @property
    def x_columns(self) -> tuple[str, ...]:
        """The names of the columns of the tables that the simulator returns, if any."""
        return self._simulator.x_columns

    def add_counts(self, num_calls: int, num_dropped: int) -> None:
        """Count what a copy of the simulator has simulated in another process."""
        self._simulator.add_counts(num_calls, num_dropped)

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed a random subset; without a count, up to ``at_least`` of them."""
        stored = self._made(progress=progress)
        return stored.from_prior(count, at_least, embed, progress=progress)

    def targets(
        self,
        theta: Tensor,
        embed: Embedding,
        *,
        simulations_per_target: int,
        num_neighbors: int,
        progress: bool,
    ) -> Tensor:
        """Average over the simulations with the nearest parameters."""
        return self._made(progress=progress).targets(
            theta,
            embed,
            simulations_per_target=simulations_per_target,
            num_neighbors=num_neighbors,
            progress=progress,
        )

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Fit a plane to the embeddings of the simulations around each theta."""
        stored = self._made(progress=progress)
        return stored.moments(theta, count, embed, progress=progress)

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Embed the simulations with the nearest parameters."""
        stored = self._made(progress=progress)
        return stored.draws(theta, count, embed, progress=progress)

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed the simulation with the nearest parameters."""
        return self._made(progress=progress).once_at(theta, embed, progress=progress)

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return up to ``count`` of the simulations."""
        return self._made(progress=progress).kept(count, progress=progress)

    def _made(self, *, progress: bool) -> StoredSimulations:
        if self._stored is None:
            # With a seed of their own, they do not depend on who asks first.
            with seeded(0):
                simulations = self._simulator.from_prior(
                    self.num_simulations,
                    self.num_simulations,
                    lambda x: x,
                    progress=progress,
                    finished=self._finished,
                )
            self._stored = StoredSimulations(
                simulations,
                self._prior,
                theta_shape=self._like.shape[1:],
                event_shape=self._event_shape,
                like=self._like,
                readable=self._readable,
                from_prior=True,
            )
            self._finished = []
        return self._stored
