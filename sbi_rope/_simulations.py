"""Where simulations come from: a simulator, or a stored set of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._validation import (
    check_batch,
    check_device,
    check_in_support,
    check_same_length,
    check_tensor,
)
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    SimulationError,
    warn_user,
)

__all__ = ["Moments", "SimulationSource", "Simulator", "StoredSimulations"]

# Simulations held in memory before they are embedded; few if they come one by one, so
# that a slow simulator shows its progress.
BATCHED_CHUNK, SINGLE_CHUNK = 1000, 10
# Seconds of work before it deserves a progress bar.
DELAY = 2.0

# Entries of simulations kept for training on them; fewer are drawn if each is large.
MAX_KEPT = 2**27
# Stored simulations around a theta behind the moments there.
NUM_AROUND = 50

Embedding = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False, kw_only=True)
class Moments:
    """Mean and covariance of the embeddings of simulations at given parameters.

    Attributes:
        mean: Shape ``(n, l)``, float64.
        covariance: Shape ``(n, l, l)``, float64.
    """

    mean: Tensor
    covariance: Tensor

    def __getitem__(self, rows: Tensor) -> "Moments":
        return Moments(mean=self.mean[rows], covariance=self.covariance[rows])

    def columns(self, columns: slice) -> "Moments":
        """Return the moments of some entries of the embeddings."""
        return Moments(
            mean=self.mean[:, columns], covariance=self.covariance[:, columns, columns]
        )


class SimulationSource(Protocol):
    """What RoPE needs of simulations, each already reduced to its embedding."""

    num_dropped: int

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Return parameters from the prior and the embedding of a simulation of each.

        Shapes ``(n_s, d)`` and ``(n_s, l)``.
        """
        ...

    def targets(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Return the mean embedding of simulations at each theta, ``(n, l)``."""
        ...

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Return mean and covariance of the embedding of simulations at each theta."""
        ...

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return up to ``count`` pairs (theta, x) from the prior, always the same."""
        ...


class Simulator:
    """A user's simulator, batched or not, checked on a few draws of the prior."""

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        prior: Distribution,
        *,
        event_shape: torch.Size,
        like: Tensor,
    ) -> None:
        if not callable(function):
            raise InvalidTypeError(
                "Expected `simulator` to be callable, from theta (n, d) to x (n, "
                f"*event); got {type(function).__name__}."
            )
        self.function = function
        self.prior = prior
        self.event_shape = event_shape
        self.like = like
        self.num_dropped = 0
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        # The probe has its own random numbers: seeded results do not depend on it.
        with seeded(0):
            self.is_batched = self._probe()

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate at parameters from the prior; drop rows that are not finite."""
        count = at_least if count is None else count
        theta = self.prior.sample(torch.Size((count,))).to(self.like)
        statistics, valid = self._embed_at(theta, embed, progress=progress)
        if not valid.any():
            raise SimulationError(
                f"All {count} simulations from the prior contain NaN or Inf."
            )
        self.num_dropped += int((~valid).sum())
        _warn_of_dropped(int((~valid).sum()), count, "simulations from the prior")
        return theta[valid], statistics[valid]

    def targets(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Simulate ``count`` times at each theta and average the finite ones."""
        statistics, valid = self._repeat_at(theta, count, embed, progress=progress)
        total = statistics.where(valid[..., None], 0.0).sum(dim=1)
        return total / valid.sum(dim=1, keepdim=True)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Simulate ``count`` times at each theta; of a single one the variance is 0."""
        embedded, valid = self._repeat_at(theta, count, embed, progress=progress)
        number = valid.sum(dim=1)[:, None]
        embedded = embedded.double().where(valid[..., None], 0.0)
        mean = embedded.sum(dim=1) / number
        centred = (embedded - mean[:, None]).where(valid[..., None], 0.0)
        squares = centred.mT @ centred
        return Moments(
            mean=mean, covariance=squares / (number[..., None] - 1).clamp_min(1)
        )

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Simulate at parameters from the prior once, for all who ask for as many."""
        count = min(count, max(1, MAX_KEPT // self.event_shape.numel()))
        if count not in self._kept:
            # Under a seed of its own, so that nothing depends on who asked first.
            with seeded(0):
                self._kept[count] = self.from_prior(
                    count, count, lambda x: x, progress=progress
                )
        return self._kept[count]

    def _repeat_at(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate at each theta, ``(n, count, l)``, and tell what is finite."""
        repeated = theta.repeat_interleave(count, dim=0)
        statistics, valid = self._embed_at(repeated, embed, progress=progress)
        dropped = int((~valid).sum())
        valid = valid.reshape(-1, count)
        statistics = statistics.reshape(*valid.shape, -1)
        self.num_dropped += dropped
        empty = ~valid.any(dim=1)
        if empty.any():
            # Not the numbers of rows: these may be a part of the pairs.
            first = theta[empty][:5].tolist()
            raise SimulationError(
                f"All simulations at the calibration parameters {first} contain NaN or "
                f"Inf ({int(empty.sum())} pairs in all). Remove these pairs."
            )
        _warn_of_dropped(
            dropped, valid.numel(), "simulations at calibration parameters"
        )
        return statistics, valid

    def _embed_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        statistics, valid = [], []
        bar = progress_bar(
            show=progress, desc="Simulating", total=len(theta), delay=DELAY
        )
        for part in theta.split(BATCHED_CHUNK if self.is_batched else SINGLE_CHUNK):
            x = self(part)
            bar.update(len(part))
            ok = torch.isfinite(x).flatten(1).all(dim=1)
            # Embedding nets may refuse NaN: give them zeros, which are dropped later.
            ok_shape = (-1,) + (1,) * (x.ndim - 1)
            statistics.append(embed(x.where(ok.reshape(ok_shape), 0.0)))
            valid.append(ok)
        bar.close()
        return torch.cat(statistics), torch.cat(valid)

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, d)`` to x ``(n, *event)``; x may contain NaN."""
        # A simulator may change its argument, or hand out the same memory twice.
        theta = theta.clone()
        try:
            if self.is_batched:
                x = self.function(theta)
            else:
                rows = [self._single(self.function(row)).clone() for row in theta]
                x = torch.cat(rows)
        except SimulationError:
            raise
        except Exception as error:
            raise SimulationError(
                f"The simulator raised {type(error).__name__} on theta of shape "
                f"{tuple(theta.shape)}: {error}"
            ) from error
        expected = (theta.shape[0], *self.event_shape)
        if not isinstance(x, Tensor) or tuple(x.shape) != expected or x.is_complex():
            raise SimulationError(
                f"Expected the simulator to return a real tensor of shape {expected}; "
                f"got {_describe(x)}."
            )
        return x.to(self.like)

    def _single(self, x: Any) -> Tensor:
        """Return one simulation with a leading dimension of one."""
        if not self._is_single(x):
            raise SimulationError(
                f"Expected the simulator to return a tensor of shape "
                f"{tuple(self.event_shape)} for one theta; got {_describe(x)}."
            )
        return x.reshape(1, *self.event_shape)

    def _is_single(self, x: Any) -> bool:
        shapes = {tuple(self.event_shape), (1, *self.event_shape)}
        if self.event_shape == (1,):
            shapes.add(())
        return isinstance(x, Tensor) and tuple(x.shape) in shapes

    def _probe(self) -> bool:
        """Find out whether the simulator takes a batch or a single theta."""
        first = self.prior.sample(torch.Size((1,))).to(self.like)
        sizes = {first.shape[1], *self.event_shape}
        # A number of rows that cannot be mistaken for a number of parameters.
        count = next(n for n in range(3, 3 + len(sizes) + 1) if n not in sizes)
        theta = first.repeat(count, 1)
        as_batch = self._attempt(theta)
        if isinstance(as_batch, Tensor) and as_batch.shape == (
            count,
            *self.event_shape,
        ):
            self._check_noise(theta, as_batch)
            return True
        single = self._attempt(theta[0])
        if self._is_single(single):
            return False
        hint = (
            " Convert NumPy results with `torch.as_tensor(x, dtype=torch.float32)`."
            if not isinstance(as_batch, Tensor | Exception)
            else ""
        )
        raise SimulationError(
            f"Expected `simulator` to map theta {tuple(theta.shape)} to x "
            f"{(count, *self.event_shape)}, or theta {tuple(theta[0].shape)} to x "
            f"{tuple(self.event_shape)}; got {_describe(as_batch)} and "
            f"{_describe(single)}.{hint}"
        ) from (as_batch if isinstance(as_batch, Exception) else None)

    def _check_noise(self, theta: Tensor, x: Tensor) -> None:
        """Warn if all rows of a batch get the same noise."""
        if bool((x == x[:1]).all()) and not torch.equal(self.function(theta), x):
            warn_user(
                "`simulator` adds the same noise to all simulations of a batch. Draw "
                "noise of the shape of the batch, or simulate row by row with "
                "`lambda theta: torch.stack([simulator(row) for row in theta])`."
            )

    def _attempt(self, theta: Tensor) -> Any:
        try:
            return self.function(theta)
        except Exception as error:  # any error of user code is an answer here
            return error


class StoredSimulations:
    """Pairs (theta, x) simulated beforehand; pairs that are not finite are dropped."""

    def __init__(
        self,
        simulations: tuple[Tensor, Tensor],
        prior: Distribution,
        *,
        theta_shape: torch.Size,
        event_shape: torch.Size,
        like: Tensor,
    ) -> None:
        if not isinstance(simulations, tuple | list) or len(simulations) != 2:
            raise InvalidTypeError(
                "Expected `simulations` to be a pair (theta, x) of tensors; got "
                f"{type(simulations).__name__}."
            )
        theta, x = simulations
        check_device(
            "simulations[0]", check_tensor("simulations[0]", theta), like.device
        )
        check_device("simulations[1]", check_tensor("simulations[1]", x), like.device)
        theta = check_batch("simulations[0]", theta, theta_shape, finite=False)
        x = check_batch("simulations[1]", x, event_shape, finite=False)
        check_same_length("simulations[0]", theta, "simulations[1]", x)
        valid = torch.isfinite(theta).all(dim=1)
        valid &= torch.isfinite(x).flatten(1).all(dim=1)
        if not valid.any():
            raise SimulationError("All stored simulations contain NaN or Inf.")
        _warn_of_dropped(int((~valid).sum()), len(valid), "stored simulations")
        check_in_support("simulations[0]", theta[valid], prior)
        self.num_dropped = int((~valid).sum())
        self.theta = theta[valid].to(like)
        self.x = x[valid].to(like)
        # "Nearest" is measured in standard deviations of the stored parameters, from
        # their mean: far from zero float32 could not tell them apart.
        self._theta_mean = self.theta.mean(dim=0)
        self._theta_std = self.theta.std(dim=0).clamp_min(1e-12)

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed a random subset; without a count, up to ``at_least`` of them."""
        available = len(self.x)
        if count is not None and count > available:
            raise InvalidInputError(
                f"Expected `num_simulations` of at most {available}, the number of "
                f"stored simulations; got {count}."
            )
        count = min(available, at_least) if count is None else count
        chosen = torch.randperm(available)[:count].to(self.x.device)
        return self.theta[chosen], embed(self.x[chosen])

    def targets(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Average over the ``count`` stored simulations with the nearest parameters."""
        if count > len(self.x):
            raise InvalidInputError(
                f"Expected `num_neighbors` of at most {len(self.x)}, the number of "
                f"stored simulations; got {count}."
            )
        nearest = self._nearest(theta, count)
        statistics = embed(self.x[nearest.flatten()])
        return statistics.reshape(*nearest.shape, -1).mean(dim=1)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Fit a plane to the embeddings of the stored simulations around each theta.

        Its height is the mean, and the covariance is that of what it leaves over.
        ``count`` has no effect: how many are around a theta depends on the number of
        parameters.
        """
        number = min(len(self.x), max(NUM_AROUND, 5 * (theta.shape[1] + 1)))
        nearest = self._nearest(theta, number)
        embedded = embed(self.x[nearest.flatten()]).double()
        embedded = embedded.reshape(*nearest.shape, -1)
        offsets = self._standardised(self.theta[nearest]).double()
        offsets = offsets - self._standardised(theta).double()[:, None]
        # A ridge keeps the plane level where the parameters around do not vary.
        design = torch.cat([torch.ones_like(offsets[..., :1]), offsets], dim=-1)
        ridge = torch.full((design.shape[-1],), 1e-6).to(design)
        ridge[0] = 0.0
        normal = design.mT @ design + ridge.diag()
        plane = torch.linalg.solve(normal, design.mT @ embedded)
        left_over = embedded - design @ plane
        freedom = max(1, number - design.shape[-1])
        return Moments(mean=plane[:, 0], covariance=left_over.mT @ left_over / freedom)

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return stored pairs, at random: they may be in some order."""
        with seeded(0):
            chosen = torch.randperm(len(self.x))[:count].to(self.x.device)
        return self.theta[chosen], self.x[chosen]

    def _nearest(self, theta: Tensor, count: int) -> Tensor:
        """Return the rows with the nearest parameters, shape ``(n, count)``."""
        stored = self._standardised(self.theta)
        distance = torch.cdist(self._standardised(theta), stored)
        return distance.topk(count, dim=1, largest=False).indices

    def _standardised(self, theta: Tensor) -> Tensor:
        return (theta - self._theta_mean) / self._theta_std


def _warn_of_dropped(dropped: int, total: int, what: str) -> None:
    if dropped:
        warn_user(
            f"Dropped {dropped} of {total} {what} because they contain NaN or Inf."
        )


def _describe(result: Any) -> str:
    if isinstance(result, Exception):
        return f"{type(result).__name__}: {result}"
    if isinstance(result, Tensor):
        return f"a tensor of shape {tuple(result.shape)} and dtype {result.dtype}"
    return f"an object of type {type(result).__name__}"
