"""A user's simulator as a source of simulations."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._simulations import (
    Embedding,
    Moments,
    Readable,
    SimulationSource,
    StoredSimulations,
    all_finite,
)
from sbi_rope._simulator.budget import LimitedSimulator
from sbi_rope._simulator.calls import Simulated, check_callable
from sbi_rope._simulator.failures import Failures, warn_of_few
from sbi_rope._simulator.probe import Probe
from sbi_rope._simulator.workers import ParallelSimulator, simulate_in_workers
from sbi_rope.errors import InvalidInputError, SimulationError, in_digits
from sbi_rope.settings import Count, check

__all__ = ["Simulator", "source_of"]

# Simulations that are held in memory before they are embedded. If they come one by one
# there are few, so that a slow simulator shows its progress.
BATCHED_CHUNK, SINGLE_CHUNK = 1000, 10
# The same if worker processes simulate one at a time, and an interrupted call can go on
# where it was. Each chunk has a seed of its own. The size is the same for any number of
# workers, so that the simulations are, too.
RESUMED_CHUNK = 100
# A progress bar appears after this many seconds.
DELAY = 2.0
# The largest number of entries of simulations kept for training. If each simulation is
# large, fewer are drawn.
MAX_KEPT = 2**27


class Simulator:
    """A user's simulator, tried on a few draws of the prior.

    Args:
        function: The simulator, batched or not, of tensors or NumPy arrays.
        prior: The prior, from which parameters are drawn.
        event_shape: Shape of one simulation.
        like: A tensor with the dtype and device of parameters and simulations.
        readable: Tells which simulations are of use. The others are dropped.

    Attributes:
        num_dropped: How many simulations were dropped because of NaN or Inf.
        num_calls: How many rows were simulated so far.
        x_columns: The names of the columns of the tables that it returns, if any.

    Raises:
        SimulationError: If the simulator does not return simulations.
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        prior: Distribution,
        *,
        event_shape: torch.Size,
        like: Tensor,
        readable: Readable = all_finite,
    ) -> None:
        check_callable(function)
        self._num_workers = None
        if isinstance(function, ParallelSimulator):
            self._num_workers, function = function.num_workers, function.simulator
        self.prior = prior
        self.event_shape = event_shape
        self.like = like
        self._readable = readable
        self.num_dropped = 0
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        # The probe has a seed of its own, so that no result depends on it.
        with seeded(0):
            probe = Probe(function, prior, event_shape=event_shape, like=like)
            self._caller = probe.find_caller(self._num_workers)
        self.num_calls = probe.num_calls
        self.x_columns = probe.x_columns

    @property
    def is_batched(self) -> bool:
        """Whether the simulator is called with batches."""
        return self._caller.form.batched

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, d)`` to x ``(n, *event)``; x may contain NaN."""
        failures = Failures(len(theta))
        simulated = self._simulate(theta, advance=lambda count: None)
        failures.add(simulated, 0)
        failures.warn()
        return simulated.x

    def add_counts(self, num_calls: int, num_dropped: int) -> None:
        """Count what a copy of the simulator has simulated in another process."""
        self.num_calls += num_calls
        self.num_dropped += num_dropped

    def from_prior(
        self,
        count: int | None,
        at_least: int,
        embed: Embedding,
        *,
        progress: bool,
        finished: list[Simulated] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Simulate at parameters from the prior; drop rows that are not finite.

        Args:
            count: The number of simulations; ``at_least`` if None.
            at_least: See ``count``.
            embed: The embedding of simulations.
            progress: Whether to show progress.
            finished: Parts that an interrupted call with the same arguments has
                simulated. They are not simulated again, and others are added.
        """
        count = at_least if count is None else count
        theta = self.prior.sample(torch.Size((count,))).to(self.like)
        failures = Failures(count)
        embedded, valid = self._embed_at(
            theta, embed, failures, progress=progress, finished=finished
        )
        if not valid.any():
            raise SimulationError(
                f"All {count} simulations from the prior contain NaN or Inf.{failures}"
            ) from failures.cause
        self.num_dropped += int((~valid).sum())
        failures.warn_of_dropped(int((~valid).sum()), "simulations from the prior")
        return theta[valid], embedded[valid]

    def targets(
        self,
        theta: Tensor,
        embed: Embedding,
        *,
        simulations_per_target: int,
        num_neighbors: int,
        progress: bool,
    ) -> Tensor:
        """Simulate several times at each theta and average the finite ones."""
        embedded, valid = self._repeat_at(
            theta, simulations_per_target, embed, progress=progress
        )
        total = embedded.where(valid[..., None], 0.0).sum(dim=1)
        return total / valid.sum(dim=1, keepdim=True)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Simulate ``count`` times at each theta; with one the covariance is zero."""
        embedded, valid = self._repeat_at(theta, count, embed, progress=progress)
        number = valid.sum(dim=1)[:, None]
        embedded = embedded.double().where(valid[..., None], 0.0)
        mean = embedded.sum(dim=1) / number
        centred = (embedded - mean[:, None]).where(valid[..., None], 0.0)
        squares = centred.mT @ centred
        return Moments(
            mean=mean, covariance=squares / (number[..., None] - 1).clamp_min(1)
        )

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Simulate ``count`` times at each theta, ``(n, count, l)``.

        A simulation that is not finite is replaced by another one of the same theta.
        """
        embedded, valid = self._repeat_at(theta, count, embed, progress=progress)
        first = valid.int().argmax(dim=1)
        usable = embedded[torch.arange(len(theta)), first][:, None]
        return embedded.where(valid[..., None], usable)

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate at each of the parameters that a label leaves possible.

        A simulation that is not finite is replaced by that of other parameters of the
        label, and its parameters are replaced by these.
        """
        embedded, valid = self._at(theta, embed, progress=progress)
        numbers = torch.arange(theta.shape[1], device=theta.device).expand(valid.shape)
        # The k-th that is missing is replaced by the k-th that is there.
        usable = (~valid).int().argsort(dim=1, stable=True)
        missing = (~valid).cumsum(dim=1) - 1
        place = missing.clamp_min(0) % valid.sum(dim=1, keepdim=True)
        chosen = numbers.where(valid, usable.gather(1, place))
        rows = torch.arange(len(theta), device=theta.device)[:, None]
        return theta[rows, chosen], embedded[rows, chosen]

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Simulate at parameters from the prior once, and keep the simulations."""
        count = min(count, max(1, MAX_KEPT // self.event_shape.numel()))
        if count not in self._kept:
            # With a seed of their own, they do not depend on who asks first.
            with seeded(0):
                self._kept[count] = self.from_prior(
                    count, count, lambda x: x, progress=progress
                )
        return self._kept[count]

    def _repeat_at(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings ``(n, count, l)`` at each theta, and which are finite."""
        repeated = theta[:, None].expand(-1, count, -1)
        return self._at(repeated, embed, progress=progress)

    def _at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate at several parameters of each pair, ``(n, count, d)``.

        Returns:
            Embeddings, shape ``(n, count, l)``, and which of them are finite.
        """
        n, count, d = theta.shape
        failures = Failures(n * count)
        embedded, valid = self._embed_at(
            theta.reshape(-1, d), embed, failures, progress=progress
        )
        dropped = int((~valid).sum())
        valid = valid.reshape(n, count)
        embedded = embedded.reshape(n, count, -1)
        self.num_dropped += dropped
        empty = ~valid.any(dim=1)
        if empty.any():
            # Row numbers would mislead, because these may be some of the pairs only.
            raise SimulationError(
                "All simulations at the calibration parameters "
                f"{in_digits(theta[empty].mean(dim=1))} contain NaN or Inf "
                f"({int(empty.sum())} pairs in all). Remove these pairs.{failures}"
            ) from failures.cause
        failures.warn_of_dropped(dropped, "simulations at calibration parameters")
        return embedded, valid

    def _embed_at(
        self,
        theta: Tensor,
        embed: Embedding,
        failures: Failures,
        *,
        progress: bool,
        finished: list[Simulated] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings of simulations, and which of them are finite."""
        parts = theta.split(self._chunk(is_resumed=finished is not None))
        embeddings, valid, start = [], [], 0
        with progress_bar(
            show=progress,
            desc=f"Calling the simulator {len(theta):,} times",
            total=len(theta),
            delay=DELAY,
        ) as bar:
            for number, part in enumerate(parts):
                simulated = self._part(number, part, finished, advance=bar.update)
                failures.add(simulated, start)
                start += len(part)
                x = simulated.x
                ok = self._readable(x)
                # Embedding nets may raise on NaN. They get zeros instead, and these
                # rows are dropped later.
                ok_shape = (-1,) + (1,) * (x.ndim - 1)
                embedded = embed(x.where(ok.reshape(ok_shape), 0.0))
                embeddings.append(embedded)
                # An embedding can overflow where x does not. Simulations with missing
                # entries were embedded when it was found out that they can be read.
                valid.append(ok & (all_finite(embedded) | ~all_finite(x)))
        return torch.cat(embeddings), torch.cat(valid)

    def _chunk(self, *, is_resumed: bool) -> int:
        """Return how many rows are simulated before they are embedded."""
        if self.is_batched:
            return BATCHED_CHUNK
        if self._num_workers is None:
            return SINGLE_CHUNK
        return RESUMED_CHUNK if is_resumed else BATCHED_CHUNK

    def _part(
        self,
        number: int,
        theta: Tensor,
        finished: list[Simulated] | None,
        *,
        advance: Callable[[int], object],
    ) -> Simulated:
        """Return the simulations of one part, which may be finished already."""
        if finished is None:
            return self._simulate(theta, advance=advance)
        if number < len(finished):
            advance(len(theta))
        else:
            # With a seed of its own, no part depends on where a call was interrupted.
            # Seed 0 is that of theta, whose numbers the noise must not repeat.
            with seeded(number + 1):
                finished.append(self._simulate(theta, advance=advance))
        return finished[number]

    def _simulate(
        self, theta: Tensor, *, advance: Callable[[int], object]
    ) -> Simulated:
        """Simulate rows, and count them."""
        if self._num_workers is None:
            simulated = self._caller.simulate(theta)
            advance(len(theta))
        else:
            simulated = simulate_in_workers(
                self._caller, theta, self._num_workers, advance=advance
            )
        self.num_calls += simulated.num_calls
        return simulated


def source_of(
    prior: Distribution,
    *,
    simulator: Callable[[Any], Any] | None,
    simulations: tuple[Tensor, Tensor] | None,
    num_simulations: int | None = None,
    event_shape: torch.Size,
    like: Tensor,
    readable: Readable = all_finite,
) -> SimulationSource:
    """Return the source of simulations: a simulator, or stored simulations.

    Args:
        prior: The prior, from which parameters are drawn.
        simulator: Maps parameters to simulations, batched or not.
        simulations: Stored pairs (theta, x).
        num_simulations: How often a simulator is called in all; as often as needed if
            None.
        event_shape: Shape of one observation.
        like: Parameters whose shape, dtype and device simulations have to fit.
        readable: As in :class:`Simulator`.

    Raises:
        InvalidInputError: If both or none of simulator and simulations are given, or
            a number of simulations without a simulator.
    """
    if (simulator is None) == (simulations is None):
        raise InvalidInputError(
            "Expected exactly one of `simulator` and `simulations`; got "
            f"{'none' if simulator is None else 'both'}. Write `RoPE(posterior, "
            "simulator=simulator)`, or `RoPE(posterior, simulations=(theta, x))` with "
            "simulations from the prior."
        )
    if num_simulations is not None:
        check("num_simulations", num_simulations, Count)
    if simulations is not None:
        if num_simulations is not None:
            raise InvalidInputError(
                "Expected `num_simulations` with a simulator only; got it with stored "
                "`simulations`, where it would have no effect."
            )
        stored = StoredSimulations(
            simulations,
            prior,
            theta_shape=like.shape[1:],
            event_shape=event_shape,
            like=like,
            readable=readable,
        )
        warn_of_few(len(stored.x))
        return stored
    assert simulator is not None
    source = Simulator(
        simulator, prior, event_shape=event_shape, like=like, readable=readable
    )
    if num_simulations is None:
        return source
    warn_of_few(num_simulations)
    return LimitedSimulator(
        source,
        num_simulations,
        prior,
        event_shape=event_shape,
        like=like,
        readable=readable,
    )
