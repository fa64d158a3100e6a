"""A user's simulator: what it takes and returns is found out before it is used."""

import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.stats import ks_2samp
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._simulations import (
    Embedding,
    Moments,
    SimulationSource,
    StoredSimulations,
    warn_of_dropped,
)
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    SimulationError,
    warn_user,
)

__all__ = ["Simulator", "source_of"]

# Simulations that are held in memory before they are embedded. If they come one by one
# there are few, so that a slow simulator shows its progress.
BATCHED_CHUNK, SINGLE_CHUNK = 1000, 10
# A progress bar appears after this many seconds.
DELAY = 2.0
# The largest number of entries of simulations kept for training. If each simulation is
# large, fewer are drawn.
MAX_KEPT = 2**27
# To find out whether rows depend on each other, a theta is simulated this often beside
# other rows. Below this p-value the simulations are of different distributions.
NUM_COMPARED, DIFFERENT = 50, 1e-6
# The comparison may take this many seconds. Slower simulators are not compared.
LONGEST = 5.0


_State = tuple[bytes, tuple[Any, ...], Any]


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
        # The probe has a seed of its own, so that no result depends on it.
        with seeded(0):
            self.is_batched = self._probe()

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate at parameters from the prior; drop rows that are not finite."""
        count = at_least if count is None else count
        theta = self.prior.sample(torch.Size((count,))).to(self.like)
        embedded, valid = self._embed_at(theta, embed, progress=progress)
        if not valid.any():
            raise SimulationError(
                f"All {count} simulations from the prior contain NaN or Inf."
            )
        self.num_dropped += int((~valid).sum())
        warn_of_dropped(int((~valid).sum()), count, "simulations from the prior")
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
        repeated = theta.repeat_interleave(count, dim=0)
        embedded, valid = self._embed_at(repeated, embed, progress=progress)
        dropped = int((~valid).sum())
        valid = valid.reshape(-1, count)
        embedded = embedded.reshape(*valid.shape, -1)
        self.num_dropped += dropped
        empty = ~valid.any(dim=1)
        if empty.any():
            # Row numbers would mislead, because these may be some of the pairs only.
            first = theta[empty][:5].tolist()
            raise SimulationError(
                f"All simulations at the calibration parameters {first} contain NaN or "
                f"Inf ({int(empty.sum())} pairs in all). Remove these pairs."
            )
        warn_of_dropped(dropped, valid.numel(), "simulations at calibration parameters")
        return embedded, valid

    def _embed_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        embeddings, valid = [], []
        bar = progress_bar(
            show=progress, desc="Simulating", total=len(theta), delay=DELAY
        )
        for part in theta.split(BATCHED_CHUNK if self.is_batched else SINGLE_CHUNK):
            x = self(part)
            bar.update(len(part))
            ok = torch.isfinite(x).flatten(1).all(dim=1)
            # Embedding nets may raise on NaN. They get zeros instead, and these rows
            # are dropped later.
            ok_shape = (-1,) + (1,) * (x.ndim - 1)
            embedded = embed(x.where(ok.reshape(ok_shape), 0.0))
            embeddings.append(embedded)
            # An embedding can overflow where x does not.
            valid.append(ok & torch.isfinite(embedded).flatten(1).all(dim=1))
        bar.close()
        return torch.cat(embeddings), torch.cat(valid)

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, d)`` to x ``(n, *event)``; x may contain NaN."""
        # A simulator may change its argument, or return the same memory twice.
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
        if not _holds_numbers(x) or tuple(x.shape) != expected or x.is_complex():
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
        return _holds_numbers(x) and tuple(x.shape) in shapes

    def _probe(self) -> bool:
        """Find out whether the simulator takes a batch or a single theta."""
        sizes = {*self.prior.event_shape, *self.event_shape}
        # A number of rows that is no number of parameters or of readings.
        count = next(n for n in range(3, 3 + len(sizes) + 1) if n not in sizes)
        draws = self.prior.sample(torch.Size((2 * count - 1,))).to(self.like)
        theta = draws[:1].repeat(count, 1)
        as_batch = self._attempt(theta)
        if self._is_batch(as_batch, count):
            self._check_noise(theta, as_batch)
            theta = draws[:count]
            x, state = self._attempt_under(0, theta)
            self._check_seeds(theta, state)
            one_by_one = self._mixes_rows(x, theta, draws[count - 1 :])
            if one_by_one and not self._is_single(self._attempt(draws[0])):
                raise SimulationError(
                    "Expected `simulator` to return x (n, *event) in which each row "
                    "depends on the same row of theta (n, d) only; what it returns for "
                    "a row changes with the other rows."
                )
            if one_by_one:
                warn_user(
                    "`simulator` returns something else for a row of a batch than for "
                    "the same theta alone: its rows depend on each other. It is "
                    "therefore called with one theta at a time. If it should take "
                    "batches, let each row of x depend on the same row of theta only."
                )
            return not one_by_one
        single, state = self._attempt_under(0, theta[0])
        if self._is_single(single):
            self._check_seeds(theta[0], state)
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
        if not bool((x == x[:1]).all()):
            return
        again = self._attempt(theta)
        if self._is_batch(again, len(x)) and not torch.equal(again, x):
            warn_user(
                "`simulator` adds the same noise to all simulations of a batch. Draw "
                "noise of the shape of the batch, or simulate row by row with "
                "`lambda theta: torch.stack([simulator(row) for row in theta])`."
            )

    def _mixes_rows(self, x: Any, theta: Tensor, others: Tensor) -> bool:
        """Tell whether the rows of simulations of a batch depend on each other.

        An example is ``lambda theta: theta * theta.norm()``, which is meant for one
        theta, but also accepts a batch.

        Args:
            x: What the simulator returns for theta under seed 0.
            theta: Parameters, shape ``(n, d)``.
            others: Other parameters, shape ``(n, d)``.
        """
        # The first row and the last row, each among other rows than before.
        batches = [theta, torch.cat([theta[:1], others[1:]])]
        batches.append(torch.cat([others[:-1], theta[-1:]]))
        rows = ((0, 1), (-1, 2))
        start = time.perf_counter()
        xs: list[Any] = [x, *(self._attempt_under(0, b)[0] for b in batches[1:])]
        seconds = (time.perf_counter() - start) / len(batches[1:])
        # A simulator that fails here raises a clear error when it is used.
        if not all(self._is_batch(x, len(theta)) for x in xs):
            return False
        if all(_is_close(xs[0][row], xs[k][row]) for row, k in rows):
            return False
        # Either the rows depend on each other, or they only get other random numbers,
        # for example because draws are rejected, or because the simulator has a
        # generator of its own. In the second case their distribution is the same.
        if 4 * NUM_COMPARED * seconds > LONGEST:
            return False
        many = [[self._attempt(b) for _ in range(NUM_COMPARED)] for b in batches]
        if not all(self._is_batch(x, len(theta)) for xs in many for x in xs):
            return False
        alone = [self._attempt(theta[0]) for _ in range(NUM_COMPARED)]
        usual, *changed = (torch.stack(xs) for xs in many)
        pairs = [(usual[:, row], changed[k - 1][:, row]) for row, k in rows]
        if all(self._is_single(x) for x in alone):
            pairs.append((usual[:, 0], torch.cat([self._single(x) for x in alone])))
        return any(_is_different(*pair) for pair in pairs)

    def _attempt_under(self, seed: int, theta: Tensor) -> tuple[Any, _State]:
        """Simulate under a seed; also return the random states afterwards."""
        with seeded(seed):
            x = self._attempt(theta)
            of_numpy: Any = np.random.get_state()  # noqa: NPY002
            return x, (
                torch.get_rng_state().numpy().tobytes(),
                (of_numpy[1].tobytes(), *of_numpy[2:]),
                random.getstate(),
            )

    def _check_seeds(self, theta: Tensor, after_zero: _State) -> None:
        """Warn if the simulator sets a seed, and so repeats its noise at every call.

        Args:
            theta: Parameters.
            after_zero: The random states after a call under seed 0.
        """
        _, after_one = self._attempt_under(1, theta)
        # A simulator that sets no seed leaves different states after different seeds.
        if any(a == b for a, b in zip(after_zero, after_one, strict=True)):
            warn_user(
                "`simulator` sets the seed of the random numbers itself, so that every "
                "call of it has the same noise. Leave the seed to the caller."
            )

    def _attempt(self, theta: Tensor) -> Any:
        """Return a copy of what the simulator returns, or the error it raises."""
        try:
            x = self.function(theta.clone())
        except Exception as error:  # any error of the user's code is a result here
            return error
        return x.clone() if _holds_numbers(x) else x

    def _is_batch(self, x: Any, count: int) -> bool:
        return _holds_numbers(x) and x.shape == (count, *self.event_shape)


def source_of(
    prior: Distribution,
    *,
    simulator: Callable[[Tensor], Tensor] | None,
    simulations: tuple[Tensor, Tensor] | None,
    event_shape: torch.Size,
    like: Tensor,
) -> SimulationSource:
    """Return the source of simulations: a simulator, or stored simulations.

    Args:
        prior: The prior, from which parameters are drawn.
        simulator: Maps parameters to simulations, batched or not.
        simulations: Stored pairs (theta, x).
        event_shape: Shape of one observation.
        like: Parameters whose shape, dtype and device simulations have to fit.

    Raises:
        InvalidInputError: If both or none of simulator and simulations are given.
    """
    if (simulator is None) == (simulations is None):
        raise InvalidInputError(
            "Expected exactly one of `simulator` and `simulations`; got "
            f"{'none' if simulator is None else 'both'}."
        )
    if simulations is not None:
        return StoredSimulations(
            simulations,
            prior,
            theta_shape=like.shape[1:],
            event_shape=event_shape,
            like=like,
        )
    assert simulator is not None
    return Simulator(simulator, prior, event_shape=event_shape, like=like)


def _holds_numbers(x: Any) -> bool:
    """Tell whether a result is a tensor with plain numbers."""
    return (
        isinstance(x, Tensor)
        and x.layout == torch.strided
        and not (x.is_nested or x.is_quantized or x.is_meta)
    )


def _is_close(a: Tensor, b: Tensor) -> bool:
    """Tell whether two simulations are about the same.

    They need not be equal, because rounding, and the steps of an adaptive solver, may
    depend on the other rows.
    """
    a, b = a.double(), b.double()
    scale = float(a.nan_to_num(0.0, 0.0, 0.0).abs().max())
    return torch.allclose(a, b, rtol=0.0, atol=0.01 * scale, equal_nan=True)


def _is_different(a: Tensor, b: Tensor) -> bool:
    """Tell whether two sets of simulations have different distributions.

    Each entry whose medians differ by more than rounding is compared by the
    Kolmogorov-Smirnov test.
    """
    a, b = a.flatten(1).double(), b.flatten(1).double()
    middle_a, middle_b = a.nanmedian(dim=0).values, b.nanmedian(dim=0).values
    scale = torch.maximum(middle_a.abs(), middle_b.abs())
    apart = (middle_a - middle_b).abs() > 1e-4 * scale
    for column in apart.nonzero().flatten().tolist():
        first, second = (
            values[~values.isnan()].cpu().numpy()
            for values in (a[:, column], b[:, column])
        )
        test: Any = ks_2samp(first, second)
        if test.pvalue < DIFFERENT / a.shape[1]:
            return True
    return False


def _describe(result: Any) -> str:
    if isinstance(result, Exception):
        return f"{type(result).__name__}: {result}"
    if isinstance(result, Tensor):
        return f"a tensor of shape {tuple(result.shape)} and dtype {result.dtype}"
    return f"an object of type {type(result).__name__}"
