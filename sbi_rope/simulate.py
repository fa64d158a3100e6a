"""Simulations: those of a user's simulator, or pairs that were stored beforehand."""

import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import joblib
import numpy as np
import torch
from scipy.stats import ks_2samp
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._units import divisors
from sbi_rope.errors import InvalidInputError, SimulationError, in_digits, warn_user
from sbi_rope.settings import Count, check
from sbi_rope.tensors import as_batch, as_numbers, check_in_support

__all__ = [
    "Embedding",
    "LimitedSimulator",
    "Moments",
    "ParallelSimulator",
    "Readable",
    "SimulationSource",
    "Simulator",
    "StoredSimulations",
    "all_finite",
    "parallel",
    "source_of",
]

Embedding = Callable[[Tensor], Tensor]
# Tells which simulations an embedding net can read, ``(n, *event)`` to ``(n,)``.
Readable = Callable[[Tensor], Tensor]

# A simulator may fail at some parameters, so that it is tried at so many.
TRIES = 5
# Rows that are simulated before they are embedded: in batches, one by one, and one by
# one in workers. A worker gets so many rows of a batch.
BATCHED_CHUNK, SINGLE_CHUNK, PARALLEL_CHUNK, ROWS_OF_WORKER = 1000, 10, 100, 100
# A progress bar appears after this many seconds.
DELAY = 2.0
# The largest number of entries of simulations that are kept for training.
MAX_KEPT = 2**27
# How many stored simulations count as simulations at a theta, and around it.
NUM_NEAR, NUM_AROUND = 10, 50
# Draws of the prior that stored parameters are compared with, and the p-value below
# which they differ.
NUM_FROM_PRIOR, NOT_FROM_PRIOR = 10_000, 1e-6
# So many distances are computed at once.
MAX_DISTANCES = 50_000_000


def all_finite(x: Tensor) -> Tensor:
    """Tell which rows are finite, which is what most embedding nets can read."""
    return torch.isfinite(x).flatten(1).all(dim=1)


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


# A user's simulator ------------------------------------------------------------------


@dataclass(frozen=True)
class ParallelSimulator:
    """A simulator that is called in worker processes, see :func:`parallel`."""

    simulator: Callable[[Any], Any]
    num_workers: int

    def __call__(self, theta: Any) -> Any:
        """Simulate in this process, exactly as the simulator does."""
        return self.simulator(theta)


def parallel(
    simulator: Callable[[Any], Any], *, num_workers: int = 1
) -> ParallelSimulator:
    """Return a simulator whose rows are simulated in several processes at once.

    Pass what it returns as ``simulator``. Each worker of joblib gets one theta at a
    time, or a hundred rows if the simulator takes batches. It pays if a call takes
    longer than about a millisecond.

    Every piece has a seed of its own, so that simulations are the same for any
    ``num_workers``, but others than without ``parallel``. A generator of the simulator
    itself must be made inside of it, with a seed from a global generator:
    ``rng = np.random.default_rng(np.random.randint(2**31))``. Otherwise all workers may
    repeat the same noise.

    Args:
        simulator: As RoPE takes it, batched or not, of tensors or NumPy arrays. It may
            be a lambda.
        num_workers: The number of processes. With 1 everything is simulated in this
            one.

    Raises:
        InvalidInputError: If an argument has the wrong type or range.

    Example:
        >>> import numpy as np
        >>> def simulator(theta):  # NumPy, and one theta at a time
        ...     return [np.sin(theta[0]), theta[1] ** 2]
        >>> parallel(simulator, num_workers=4).num_workers
        4
    """
    check("simulator", simulator, Callable)
    check("num_workers", num_workers, Count)
    return ParallelSimulator(simulator, int(num_workers))


# Simulations ``(n, *event)`` with NaN where the simulator raised, the number of rows
# that were simulated for them, and the first error.
Simulated = tuple[Tensor, int, Exception | None]


@dataclass(frozen=True, eq=False)
class _Way:
    """A way to call a simulator: with a batch or one theta, as tensors or arrays."""

    function: Callable[[Any], Any]
    batched: bool
    arrays: bool
    event_shape: torch.Size
    like: Tensor

    def result(self, theta: Tensor) -> Any:
        """Call the simulator with a copy of theta, because it may change it.

        Arrays hold float64, as solvers of SciPy expect.
        """
        if self.arrays:
            return self.function(theta.to("cpu", torch.float64, copy=True).numpy())
        return self.function(theta.clone())

    def fitted(self, result: Any, theta: Tensor) -> Tensor:
        """Return a copy of what theta ``(n, d)`` or ``(d,)`` gave as a tensor.

        Dimensions of size one may be missing. The simulator may use the memory of its
        result again.
        """
        x = as_numbers("simulator(theta)", result)
        expected = (*theta.shape[:-1], *self.event_shape)
        if [n for n in x.shape if n != 1] != [n for n in expected if n != 1]:
            raise SimulationError(
                f"Expected `simulator` to return x of shape {expected} for theta of "
                f"shape {tuple(theta.shape)}; got {tuple(x.shape)}."
            )
        return x.reshape(expected).to(self.like, copy=True)

    def simulate(self, theta: Tensor) -> Simulated:
        """Simulate theta ``(n, d)``; if a batch raises, its rows one by one."""
        error, num_calls, rows = None, len(theta), []
        if self.batched:
            try:
                return self.fitted(self.result(theta), theta), num_calls, None
            except Exception as raised:  # any error of the user's code
                error, num_calls = raised, 2 * num_calls
        for one in theta.split(1) if self.batched else theta:
            try:
                x = self.fitted(self.result(one), one).reshape(self.event_shape)
            except Exception as raised:
                error = error or raised
                x = self.like.new_full(self.event_shape, torch.nan)
            rows.append(x)
        return torch.stack(rows), num_calls, error


def _simulate_piece(way: _Way, theta: Tensor, seed: int) -> Simulated:
    """Simulate in a worker, with an error that can be sent from there."""
    with seeded(seed):
        x, num_calls, error = way.simulate(theta)
    return x, num_calls, error and SimulationError(f"{type(error).__name__}: {error}")


class Simulator:
    """A user's simulator, called in the first way in which it returns the right shape.

    Args:
        function: The simulator, batched or not, of tensors or NumPy arrays.
        prior: The prior, from which parameters are drawn.
        event_shape: Shape of one simulation.
        like: A tensor with the dtype and device of parameters and simulations.
        readable: Tells which simulations are of use. The others are dropped.

    Attributes:
        num_dropped: How many simulations were dropped so far.
        num_calls: How many rows were simulated so far.
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
        check("simulator", function, Callable)
        self._num_workers: int | None = None
        if isinstance(function, ParallelSimulator):
            self._num_workers, function = function.num_workers, function.simulator
        self._prior, self._event_shape, self._like = prior, event_shape, like
        self._readable = readable
        self.num_dropped = self.num_calls = 0
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        # With a seed of its own, so that no result depends on it.
        with seeded(0):
            self._way = self._working_way(function)

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, d)`` to x ``(n, *event)``; x may contain NaN."""
        return self._simulate(theta)[0]

    def from_prior(
        self,
        count: int | None,
        at_least: int,
        embed: Embedding,
        *,
        progress: bool,
        finished: list[Simulated] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return parameters from the prior, and the embedding of one simulation each.

        There are ``count`` of them, or ``at_least`` if that is None. Parts that are
        ``finished`` are not simulated again, and others are added there.
        """
        count = at_least if count is None else count
        theta = self._prior.sample(torch.Size((count,))).to(self._like)
        embedded, valid = self._embedded(
            theta, embed, "from the prior", progress=progress, finished=finished
        )
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
        r"""Return :math:`E_\varepsilon[h(S(\theta_i))]`, ``(n, l)``.

        A simulator makes ``simulations_per_target`` simulations at each theta. Of
        stored simulations, those with the ``num_neighbors`` nearest parameters count.
        """
        repeated = theta[:, None].expand(-1, simulations_per_target, -1)
        return self._at(repeated, embed, progress=progress).nanmean(dim=1)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Simulate ``count`` times at each theta; with one the covariance is zero."""
        repeated = theta[:, None].expand(-1, count, -1)
        embedded = self._at(repeated, embed, progress=progress).double()
        mean = embedded.nanmean(dim=1)
        centred = (embedded - mean[:, None]).nan_to_num(0.0)
        number = (~embedded.isnan().all(dim=2)).sum(dim=1)[:, None, None]
        covariance = centred.mT @ centred / (number - 1).clamp_min(1)
        return Moments(mean=mean, covariance=covariance)

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Simulate ``count`` times at each theta, ``(n, count, l)``."""
        repeated = theta[:, None].expand(-1, count, -1)
        return self.once_at(repeated, embed, progress=progress)[1]

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Simulate once at each of several parameters of each pair, ``(n, R, d)``.

        A simulation that failed is replaced by that of other parameters of the pair.
        These are returned with the embeddings ``(n, R, l)``.
        """
        embedded = self._at(theta, embed, progress=progress)
        failed = embedded.isnan().all(dim=2)
        numbers = torch.arange(theta.shape[1], device=theta.device).expand(failed.shape)
        # The k-th that failed is replaced by the k-th that is there.
        usable = failed.int().argsort(dim=1, stable=True)
        place = (failed.cumsum(dim=1) - 1).clamp_min(0)
        place = place % (~failed).sum(dim=1, keepdim=True)
        chosen = numbers.where(~failed, usable.gather(1, place))
        rows = torch.arange(len(theta), device=theta.device)[:, None]
        return theta[rows, chosen], embedded[rows, chosen]

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return up to ``count`` pairs (theta, x) from the prior, always the same."""
        count = min(count, max(1, MAX_KEPT // self._event_shape.numel()))
        if count not in self._kept:
            # With a seed of their own, they do not depend on who asks first.
            with seeded(0):
                self._kept[count] = self.from_prior(
                    count, count, lambda x: x, progress=progress
                )
        return self._kept[count]

    def _working_way(self, function: Callable[[Any], Any]) -> _Way:
        """Try batches before single parameters, and tensors before arrays.

        A simulator that makes something else than a tensor from tensors is given arrays
        if it takes them, because it was written for these. One that was written for a
        single theta may take a batch, and add the same noise to all rows.
        """
        sizes = {*self._prior.event_shape, *self._event_shape}
        # A number of rows that is no number of parameters or of readings.
        num_rows = next(n for n in range(3, 4 + len(sizes)) if n not in sizes)
        errors: list[Exception] = []
        for theta in self._prior.sample(torch.Size((TRIES,))).to(self._like):
            for batched in (True, False):
                given = theta.repeat(num_rows, 1) if batched else theta
                second_best = None
                for arrays in (False, True):
                    way = _Way(function, batched, arrays, self._event_shape, self._like)
                    self.num_calls += num_rows if batched else 1
                    try:
                        with warnings.catch_warnings():
                            # NumPy warns of tensors, which may not be the right way.
                            warnings.simplefilter("ignore")
                            result = way.result(given)
                            x = way.fitted(result, given)
                            if batched and bool((x == x[0]).all()):
                                self.num_calls += num_rows
                                if not torch.equal(way.simulate(given)[0], x):
                                    raise SimulationError(
                                        "All rows of a batch have the same noise."
                                    )
                    except Exception as raised:  # any error of the user's code
                        errors.append(raised)
                        continue
                    if arrays or isinstance(result, Tensor):
                        return way
                    second_best = way
                if second_best is not None:
                    return second_best
        raise SimulationError(
            "Expected `simulator` to map theta (n, d) to x (n, *event), or one (d,) to "
            f"one (*event), where *event is {tuple(self._event_shape)}; a batch "
            f"of tensors gave {errors[0]!r}, and one array {errors[-1]!r}."
        ) from errors[-1]

    def _at(self, theta: Tensor, embed: Embedding, *, progress: bool) -> Tensor:
        """Simulate at several parameters of each pair, ``(n, R, d)`` to ``(n, R, l)``.

        Embeddings of simulations that failed are NaN.
        """
        where = "at calibration parameters"
        embedded, valid = self._embedded(
            theta.flatten(0, 1), embed, where, progress=progress
        )
        empty = ~valid.reshape(theta.shape[:2]).any(dim=1)
        if empty.any():
            # Row numbers would mislead, because these may be some of the pairs only.
            raise SimulationError(
                "All simulations at the calibration parameters "
                f"{in_digits(theta[empty].mean(dim=1))} failed. Remove these pairs."
            )
        embedded = embedded.where(valid[:, None], torch.nan)
        return embedded.reshape(*theta.shape[:2], -1)

    def _embedded(
        self,
        theta: Tensor,
        embed: Embedding,
        where: str,
        *,
        progress: bool,
        finished: list[Simulated] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings ``(n, l)`` of simulations, and which of them are finite."""
        embeddings, valid, error = [], [], None
        chunk = PARALLEL_CHUNK if self._num_workers else SINGLE_CHUNK
        parts = theta.split(BATCHED_CHUNK if self._way.batched else chunk)
        with progress_bar(
            show=progress,
            desc=f"Calling the simulator {len(theta):,} times",
            total=len(theta),
            delay=DELAY,
        ) as bar:
            for number, part in enumerate(parts):
                if finished is None:
                    x, _, raised = self._simulate(part)
                else:
                    if number == len(finished):
                        # With a seed of its own, no part depends on where a call was
                        # interrupted. Seed 0 is that of theta.
                        with seeded(number + 1):
                            finished.append(self._simulate(part))
                    x, _, raised = finished[number]
                bar.update(len(part))
                error = error or raised
                ok = self._readable(x)
                # Embedding nets may raise on NaN. They get zeros instead.
                embedded = embed(x.where(ok.reshape(-1, *[1] * (x.ndim - 1)), 0.0))
                embeddings.append(embedded)
                # An embedding can overflow where x does not. Simulations with missing
                # entries were embedded when it was found out that they can be read.
                valid.append(ok & (all_finite(embedded) | ~all_finite(x)))
        ok = torch.cat(valid)
        dropped = int((~ok).sum())
        self.num_dropped += dropped
        because = "" if error is None else f" The simulator raised {error!r}."
        if dropped == len(ok):
            raise SimulationError(
                f"All {dropped} simulations {where} are not finite.{because}"
            ) from error
        if dropped:
            warn_user(
                f"Dropped {dropped} of {len(ok)} simulations {where} "
                f"({dropped / len(ok):.1%}), which are not finite.{because}"
            )
        return torch.cat(embeddings), ok

    def _simulate(self, theta: Tensor) -> Simulated:
        """Simulate rows, in this process or in workers, and count them."""
        if self._num_workers is None:
            results = [self._way.simulate(theta)]
        else:
            pieces = theta.split(ROWS_OF_WORKER if self._way.batched else 1)
            seeds = torch.randint(2**31, (len(pieces),)).tolist()
            # A seeded block waits for those of other threads, so that these do not do.
            run: Any = joblib.Parallel(n_jobs=self._num_workers, backend="loky")
            results = run(
                joblib.delayed(_simulate_piece)(self._way, piece, seed)
                for piece, seed in zip(pieces, seeds, strict=True)
            )
        xs, num_calls, errors = zip(*results, strict=True)
        self.num_calls += sum(num_calls)
        return torch.cat(xs), sum(num_calls), next(filter(None, errors), None)


# Stored simulations ------------------------------------------------------------------


class StoredSimulations:
    """Pairs (theta, x), with theta from the prior, without those that are not finite.

    The methods and the other arguments are those of :class:`Simulator`.
    """

    num_calls: int = 0
    num_dropped: int = 0

    def __init__(
        self,
        simulations: tuple[Tensor, Tensor],
        prior: Distribution,
        *,
        event_shape: torch.Size,
        like: Tensor,
        readable: Readable = all_finite,
    ) -> None:
        theta, x = simulations
        options: Any = {"device": like.device, "finite": False}
        theta = as_batch("simulations[0]", theta, prior.event_shape, **options)
        x = as_batch("simulations[1]", x, event_shape, rows=len(theta), **options)
        theta, x = theta.to(like), x.to(like)
        valid = torch.isfinite(theta).all(dim=1) & readable(x)
        if not valid.any():
            raise SimulationError("All stored simulations contain NaN or Inf.")
        self.num_dropped = int((~valid).sum())
        if self.num_dropped:
            warn_user(
                f"Dropped {self.num_dropped} of {len(valid)} stored simulations "
                f"({self.num_dropped / len(valid):.1%}), which are not finite."
            )
        theta, x = theta[valid], x[valid]
        check_in_support("simulations[0]", theta, prior)
        with seeded(0):
            drawn = prior.sample(torch.Size((NUM_FROM_PRIOR,)))
        compare: Any = functools.partial(ks_2samp, method="asymp")
        unlike = [
            number
            for number, pair in enumerate(
                zip(theta.T.cpu(), drawn.T.cpu(), strict=True)
            )
            if compare(*map(np.asarray, pair)).pvalue < NOT_FROM_PRIOR
        ]
        if unlike:
            warn_user(
                f"The parameters {unlike} of `simulations` (counted from 0) are not "
                "distributed like the prior, as whose draws they are used."
            )
        self._pairs = theta, x

    def from_prior(
        self, count: int | None, at_least: int, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed a random subset; without a count, up to ``at_least`` of them."""
        theta, x = self._made(progress=progress)
        if count is not None and count > len(x):
            raise InvalidInputError(
                f"Expected `num_simulations` of at most {len(x)}, the number of stored "
                f"simulations; got {count}."
            )
        chosen = torch.randperm(len(x))[: at_least if count is None else count]
        chosen = chosen.to(x.device)
        return theta[chosen], embed(x[chosen])

    def targets(
        self,
        theta: Tensor,
        embed: Embedding,
        *,
        simulations_per_target: int,
        num_neighbors: int,
        progress: bool,
    ) -> Tensor:
        """Average over the stored simulations with the nearest parameters."""
        return self._near(theta, num_neighbors, embed, progress=progress).mean(dim=1)

    def moments(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Moments:
        """Fit a plane to the embeddings of the stored simulations around each theta.

        The mean is the height of the plane at theta, and the covariance is that of the
        residuals. ``count`` has no effect: the number of stored simulations around a
        theta depends on the number of parameters.
        """
        stored, x = self._made(progress=progress)
        number = min(len(x), max(NUM_AROUND, 5 * (theta.shape[1] + 1)))
        nearest, stored, theta = _nearest(stored, theta, number)
        embedded = embed(x[nearest.flatten()]).double()
        embedded = embedded.reshape(*nearest.shape, -1)
        offsets = stored[nearest].double() - theta.double()[:, None]
        # The ridge keeps the plane level if the parameters around theta do not vary.
        design = torch.cat([torch.ones_like(offsets[..., :1]), offsets], dim=-1)
        ridge = torch.full((design.shape[-1],), 1e-6).to(design)
        ridge[0] = 0.0
        normal = design.mT @ design + ridge.diag()
        plane = torch.linalg.solve(normal, design.mT @ embedded)
        left_over = embedded - design @ plane
        freedom = max(1, number - design.shape[-1])
        return Moments(mean=plane[:, 0], covariance=left_over.mT @ left_over / freedom)

    def draws(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Embed the simulations with the nearest parameters, at most ten."""
        return self._near(theta, min(count, NUM_NEAR), embed, progress=progress)

    def once_at(
        self, theta: Tensor, embed: Embedding, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Embed the stored simulation with the nearest parameters."""
        embedded = self._near(theta.flatten(0, 1), 1, embed, progress=progress)
        return theta, embedded.reshape(*theta.shape[:2], -1)

    def kept(self, count: int, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return stored pairs, chosen at random because they may be sorted."""
        theta, x = self._made(progress=progress)
        with seeded(0):
            chosen = torch.randperm(len(x))[:count].to(x.device)
        return theta[chosen], x[chosen]

    def _made(self, *, progress: bool) -> tuple[Tensor, Tensor]:
        """Return all pairs."""
        return self._pairs

    def _near(
        self, theta: Tensor, count: int, embed: Embedding, *, progress: bool
    ) -> Tensor:
        """Embed the ``count`` simulations near each theta, ``(n, count, l)``."""
        stored, x = self._made(progress=progress)
        nearest, _, _ = _nearest(stored, theta, min(count, len(x)))
        return embed(x[nearest.flatten()]).reshape(*nearest.shape, -1)


class LimitedSimulator(StoredSimulations):
    """Simulations that are made when they are first needed, and then are stored ones.

    If that is interrupted, the next call goes on where it was.
    """

    def __init__(self, simulator: Simulator, num_simulations: int) -> None:
        self.num_simulations = num_simulations
        self.simulator = simulator
        self._finished: list[Simulated] = []
        self._all: tuple[Tensor, Tensor] | None = None

    @property
    def num_calls(self) -> int:  # type: ignore[override]
        """How many rows the simulator has simulated."""
        return self.simulator.num_calls

    @property
    def num_dropped(self) -> int:  # type: ignore[override]
        """How many simulations were dropped."""
        return self.simulator.num_dropped

    def _made(self, *, progress: bool) -> tuple[Tensor, Tensor]:
        if self._all is None:
            # With a seed of their own, they do not depend on who asks first.
            with seeded(0):
                self._all = self.simulator.from_prior(
                    self.num_simulations,
                    self.num_simulations,
                    lambda x: x,
                    progress=progress,
                    finished=self._finished,
                )
            self._finished = []
        return self._all


SimulationSource = Simulator | StoredSimulations


def _nearest(
    stored: Tensor, theta: Tensor, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows nearest to each theta, ``(n, count)``, and both standardised.

    The mean is subtracted, because float32 cannot tell numbers far from zero apart.
    """
    mean, std = stored.mean(dim=0), divisors(stored.double().std(dim=0)).to(stored)
    stored, theta = (stored - mean) / std, (theta - mean) / std
    # Imperfect labels have many possible parameters each, too many for one matrix.
    rows = [
        torch.cdist(some, stored).topk(count, dim=1, largest=False).indices
        for some in theta.split(max(1, MAX_DISTANCES // len(stored)))
    ]
    return torch.cat(rows), stored, theta


def source_of(
    prior: Distribution,
    *,
    simulator: Any,
    simulations: Any,
    num_simulations: int | None = None,
    event_shape: torch.Size,
    like: Tensor,
    readable: Readable = all_finite,
) -> SimulationSource:
    """Return a simulator, called ``num_simulations`` times at most, or stored pairs.

    The other arguments are those of :class:`Simulator` and :class:`StoredSimulations`.
    """
    check("num_simulations", num_simulations, Count | None)
    if (simulator is None) == (simulations is None):
        raise InvalidInputError(
            "Expected exactly one of `simulator` and `simulations`; got "
            f"{'none' if simulator is None else 'both'}."
        )
    options: Any = {"event_shape": event_shape, "like": like, "readable": readable}
    if simulations is not None:
        if num_simulations is not None:
            raise InvalidInputError("Expected `num_simulations` with a simulator only.")
        return StoredSimulations(simulations, prior, **options)
    source = Simulator(simulator, prior, **options)
    return (
        source if num_simulations is None else LimitedSimulator(source, num_simulations)
    )
