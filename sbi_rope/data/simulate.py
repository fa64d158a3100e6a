"""Sources of simulations, and what simulations at the labels of pairs are like."""

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import joblib
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.data.pairs import Pairs, Rows
from sbi_rope.npe.prior import check_in_support
from sbi_rope.utils.errors import InvalidInputError, SimulationError, warn_user
from sbi_rope.utils.progress import is_shown, progress_bar
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Settings, check
from sbi_rope.utils.tensors import as_batch, as_numbers, divisors

Embed = Callable[[Tensor], Tensor]
# Tells which simulations an embedding net can read, ``(n, *event)`` to ``(n,)``.
Readable = Callable[[Tensor], Tensor]
# Simulations ``(n, *event)``, NaN where the simulator raised, and its first error.
Result = tuple[Tensor, str]

# Parameters at which a simulator is tried, because it may fail at some.
TRIES = 5
# Rows that are simulated before they are embedded, in batches and one by one, and those
# of a batch that a worker gets.
BATCHED_CHUNK, SINGLE_CHUNK, ROWS_OF_WORKER = 1000, 100, 100
# Seconds after which a progress bar appears.
DELAY = 2.0
# The most numbers in simulations that are kept, in distances that are computed at once,
# and in the simulations that planes are fitted to at once.
MAX_KEPT, MAX_DISTANCES, MAX_NUMBERS = 2**27, 50_000_000, 2**24
# The fewest stored simulations that a plane is fitted to, and the ridge that keeps it
# level where parameters do not vary.
NUM_AROUND, LEVEL = 50, 1e-6
# The fewest simulations for each coefficient of a quadratic surface, and a ridge
# relative to the number of simulations.
SIMULATIONS_PER_COEFFICIENT, RIDGE = 3, 1e-4


def all_finite(x: Tensor) -> Tensor:
    """Tell which rows are finite, which is what most embedding nets can read."""
    return torch.isfinite(x).flatten(1).all(dim=1)


@dataclass(frozen=True, kw_only=True)
class ParallelSimulator(Settings):
    """A simulator that is called in worker processes, see :func:`parallel`."""

    simulator: Callable[[Any], Any]
    num_workers: Count

    def __call__(self, theta: Any) -> Any:
        """Simulate in this process, exactly as the simulator does."""
        return self.simulator(theta)


def parallel(
    simulator: Callable[[Any], Any], *, num_workers: int = 1
) -> ParallelSimulator:
    """Return a simulator whose rows are simulated in several processes at once.

    It pays if a call takes longer than about a millisecond. Simulations are the same
    for any ``num_workers``, but others than without ``parallel``. Seed a generator of
    your own inside the simulator from a global one, or all workers may repeat the same
    noise: ``rng = np.random.default_rng(np.random.randint(2**31))``.

    Args:
        simulator: As RoPE takes it. It may be a lambda.
        num_workers: The number of processes. With 1 all is simulated in this one.

    Example:
        >>> import numpy as np
        >>> def simulator(theta):  # NumPy, and one theta at a time
        ...     return [np.sin(theta[0]), theta[1] ** 2]
        >>> parallel(simulator, num_workers=4).num_workers
        4
    """
    return ParallelSimulator(simulator=simulator, num_workers=num_workers)


@dataclass(frozen=True, eq=False)
class _Way:
    """A way to call a simulator: with a batch or one theta, as tensors or arrays."""

    function: Callable[[Any], Any]
    batched: bool
    kind: str
    like: Tensor

    def x_of(self, theta: Tensor) -> Tensor:
        """Return x, in which dimensions of size one may be missing, as a tensor."""
        # Copies, because the simulator may change theta or use x again. Arrays hold
        # float64, as solvers of SciPy expect.
        if self.kind == "array":
            result = self.function(theta.to("cpu", torch.float64, copy=True).numpy())
        else:
            result = self.function(theta.clone())
        if self.kind == "tensor to tensor" and not isinstance(result, Tensor):
            raise SimulationError("A tensor gave something else than a tensor.")
        x = as_numbers("simulator(theta)", result)
        expected = (*theta.shape[:-1], *self.like.shape[1:])
        if [n for n in x.shape if n != 1] != [n for n in expected if n != 1]:
            raise SimulationError(
                f"Expected `simulator` to return x of shape {expected} for theta of "
                f"shape {tuple(theta.shape)}; got {tuple(x.shape)}."
            )
        return x.reshape(expected).to(self.like, copy=True)

    def simulate(self, theta: Tensor, seed: int | None = None) -> Result:
        """Simulate theta ``(n, d)``; if a batch raises, its rows one by one."""
        x, error = self.like.new_full((len(theta), *self.like.shape[1:]), torch.nan), ""
        alone: Any = [slice(k, k + 1) if self.batched else k for k in range(len(theta))]
        with seeded(seed):
            for rows in ([slice(None)], alone) if self.batched else (alone,):
                error = ""
                for row in rows:
                    try:
                        x[row] = self.x_of(theta[row])
                    except Exception as raised:  # of any type
                        error = error or repr(raised)
                if not error:
                    break
        return x, error


class Simulated:
    """A user's simulator, called in the first way in which it returns the right shape.

    Simulations that are not ``readable`` are dropped, counted and warned of.
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        prior: Distribution,
        *,
        like: Tensor,
        readable: Readable = all_finite,
    ) -> None:
        check("simulator", function, Callable)
        self._num_workers = 0
        if isinstance(function, ParallelSimulator):
            self._num_workers, function = function.num_workers, function.simulator
        self._prior, self._like, self._readable = prior, like, readable
        self.num_dropped = self.num_calls = 0
        self._kept: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
        with seeded(0):
            self._way = self._working_way(function)

    def from_prior(
        self, n: int, *, seed: int | None = None, progress: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Return n parameters from the prior, and a simulation of each.

        With a seed they are simulated once and kept, as many as memory allows.
        """
        if seed is None:
            theta = self._prior.sample(torch.Size((n,))).to(self._like)
            x, ok = self._embedded(
                theta, lambda x: x, "from the prior", progress=progress
            )
            return theta[ok], x[ok]
        n = min(n, max(1, MAX_KEPT // self._like.shape[1:].numel()))
        if (n, seed) not in self._kept:
            with seeded(seed):
                self._kept[n, seed] = self.from_prior(n, progress=progress)
        return self._kept[n, seed]

    def at(self, theta: Tensor, embed: Embed, *, progress: bool = False) -> Tensor:
        """Simulate at parameters of n pairs, ``(n, S, d)`` to ``(n, S, l)``.

        Embeddings of simulations that failed are NaN.
        """
        z, ok = self._embedded(
            theta.flatten(0, 1), embed, "at calibration parameters", progress=progress
        )
        empty = ~ok.reshape(theta.shape[:2]).any(dim=1)
        if empty.any():
            raise SimulationError(
                "All simulations at the calibration parameters "
                f"{theta[empty].mean(dim=1)[:5].tolist()} failed. Remove these pairs."
            )
        return z.where(ok[:, None], torch.nan).reshape(*theta.shape[:2], -1)

    def _working_way(self, function: Callable[[Any], Any]) -> _Way:
        """Try batches before single parameters, and tensors before arrays."""
        event_shape = tuple(self._like.shape[1:])
        sizes = {*self._prior.event_shape, *event_shape}
        # A number of rows that is no number of parameters or of readings.
        num_rows = next(n for n in range(3, 4 + len(sizes)) if n not in sizes)
        kinds = ("tensor to tensor", "array", "tensor")
        thetas = self._prior.sample(torch.Size((TRIES,))).to(self._like)
        errors: dict[Any, Exception] = {}
        for theta, batched, kind in itertools.product(thetas, (True, False), kinds):
            way = _Way(function, batched, kind, self._like)
            given = theta.repeat(num_rows, 1) if batched else theta
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # NumPy warns of tensors
                    x = way.x_of(given)
                    is_repeated = batched and bool((x == x[0]).all())
                    # Written for one theta, it may add one noise to all rows.
                    if is_repeated and not torch.equal(way.x_of(given), x):
                        raise SimulationError("All rows have the same noise.")
                return way
            except Exception as raised:  # any error of the user's code
                errors[batched, kind] = raised
        of_array = errors[False, "array"]
        raise SimulationError(
            "Expected `simulator` to map theta (n, d) to x (n, *event), or one (d,) to "
            f"one (*event), where *event is {event_shape}; a batch of tensors gave "
            f"{errors[True, 'tensor']!r}, and one array {of_array!r}."
        ) from of_array

    def _embedded(
        self, theta: Tensor, embed: Embed, where: str, *, progress: bool
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings ``(n, l)`` of simulations, and which of them are finite."""
        embeddings, valid, first_error = [], [], ""
        size = BATCHED_CHUNK if self._way.batched else SINGLE_CHUNK
        label = f"Calling the simulator {len(theta):,} times"
        options = {"desc": label, "total": len(theta), "delay": DELAY}
        with progress_bar(show=progress, **options) as bar:
            for part in theta.split(size):
                x, error = self.simulate(part)
                bar.update(len(part))
                first_error = first_error or error
                ok = self._readable(x)
                # Embedding nets may raise on NaN. They get zeros instead.
                z = embed(x.where(ok.reshape(-1, *[1] * (x.ndim - 1)), 0.0))
                embeddings.append(z)
                # An embedding can overflow where x does not. Missing entries that the
                # net can read are fine.
                valid.append(ok & (all_finite(z) | ~all_finite(x)))
        ok = torch.cat(valid)
        because = f" The simulator raised {first_error}." if first_error else ""
        if not ok.any():
            raise SimulationError(
                f"All {len(ok)} simulations {where} are not finite.{because}"
            )
        self.num_dropped += _warn_of_dropped(ok, f"simulations {where}", because)
        return torch.cat(embeddings), ok

    def simulate(self, theta: Tensor) -> Result:
        """Simulate theta ``(n, d)``, in this process or in workers, and count rows."""
        self.num_calls += len(theta)
        if not self._num_workers:
            return self._way.simulate(theta)
        pieces = theta.split(ROWS_OF_WORKER if self._way.batched else 1)
        seeds = torch.randint(2**31, (len(pieces),)).tolist()
        run: Any = joblib.Parallel(n_jobs=self._num_workers, backend="loky")
        results = run(map(joblib.delayed(self._way.simulate), pieces, seeds))
        xs, errors = zip(*results, strict=True)
        return torch.cat(xs), next(filter(None, errors), "")


def _warn_of_dropped(ok: Tensor, what: str, because: str = "") -> int:
    """Warn of simulations that are not finite, and return their number."""
    if dropped := int((~ok).sum()):
        warn_user(
            f"Dropped {dropped} of {len(ok)} {what} ({dropped / len(ok):.1%}), which "
            f"are not finite.{because}"
        )
    return dropped


class Stored:
    """Stored pairs of theta ``(N, d)`` from the prior and x ``(N, *event)``."""

    num_calls = num_dropped = 0

    def __init__(self, theta: Tensor, x: Tensor) -> None:
        self.theta, self.x = theta, x

    def from_prior(
        self, n: int, *, seed: int | None = None, progress: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Return up to n pairs, chosen at random."""
        with seeded(seed):
            chosen = torch.randperm(len(self.x))[:n].to(self.x.device)
        return self.theta[chosen], self.x[chosen]

    def at(self, theta: Tensor, embed: Embed, *, progress: bool = False) -> Tensor:
        r"""Return stored simulations near the parameters, moved to them.

        A plane is fitted to the embeddings z of the K nearest simulations: 50 or, with
        many parameters, five for each coefficient. These are moved along it to theta,

        .. math:: z(\theta) + c\, r_k, \qquad c^2 = (K - 1) / (K - d - 1),

        where c makes up for what the plane takes from the residuals r. The s-th theta
        of a pair takes the s-th nearest simulation, so that residuals do not repeat.

        Source: regression adjustment, https://doi.org/10.1093/genetics/162.4.2025.
        """
        n, count, d = theta.shape
        number = min(len(self.x), max(NUM_AROUND, 5 * (d + 1)))
        # Exact parameters are the same for all s.
        at, place = theta.flatten(0, 1).unique(dim=0, return_inverse=True)
        nearest, stored, at = _nearest(self.theta, at, number)
        used, row = nearest.unique(return_inverse=True)
        z = torch.cat([embed(self.x[some]) for some in used.split(BATCHED_CHUNK)])
        turn = (torch.arange(count) % number).repeat(n).to(place)
        ridge = torch.tensor([0.0] + [LEVEL] * d).to(at).double().diag()
        scale = ((number - 1) / max(1, number - d - 1)) ** 0.5
        chunk, moved = max(1, MAX_NUMBERS // (number * z[0].numel())), []
        for of, k in zip(place.split(chunk), turn.split(chunk), strict=True):
            offsets = stored[nearest[of]].double() - at[of].double()[:, None]
            design = torch.cat([torch.ones_like(offsets[..., :1]), offsets], dim=-1)
            around = z[row[of]].double()
            normal = design.mT @ design + ridge
            plane = torch.linalg.solve(normal, design.mT @ around)
            each = torch.arange(len(of)).to(of)
            residual = around[each, k] - (design[each, None, k] @ plane)[:, 0]
            moved.append((plane[:, 0] + scale * residual).to(z))
        return torch.cat(moved).reshape(n, count, -1)


def _nearest(
    stored: Tensor, theta: Tensor, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows nearest to each theta, ``(n, count)``, and both standardised."""
    # float32 cannot tell numbers far from zero apart, hence the mean.
    mean, std = stored.mean(dim=0), divisors(stored.double().std(dim=0)).to(stored)
    stored, theta = (stored - mean) / std, (theta - mean) / std
    # Labels that are not exact have many parameters each, too many for one matrix.
    rows = [
        torch.cdist(some, stored).topk(count, dim=1, largest=False).indices
        for some in theta.split(max(1, MAX_DISTANCES // len(stored)))
    ]
    return torch.cat(rows), stored, theta


Source = Simulated | Stored


def source_of(
    prior: Distribution,
    *,
    simulator: Any,
    simulations: Any,
    num_simulations: int | None = None,
    like: Tensor,
    readable: Readable = all_finite,
) -> Source:
    """Return a simulator or stored pairs, which a budget of simulations becomes."""
    check("num_simulations", num_simulations, Count | None)
    if (simulator is None) == (simulations is None):
        raise InvalidInputError(
            "Expected exactly one of `simulator` and `simulations`; got "
            f"{'none' if simulator is None else 'both'}."
        )
    if simulations is None:
        source = Simulated(simulator, prior, like=like, readable=readable)
        if num_simulations is None:
            return source
        shown = is_shown(None)
        stored = Stored(*source.from_prior(num_simulations, seed=0, progress=shown))
        stored.num_calls, stored.num_dropped = source.num_calls, source.num_dropped
        return stored
    if num_simulations is not None:
        raise InvalidInputError("Expected `num_simulations` with a simulator only.")
    theta, x = simulations
    options: Any = {"device": like.device, "finite": False}
    theta = as_batch("simulations[0]", theta, prior.event_shape, **options).to(like)
    x = as_batch("simulations[1]", x, like.shape[1:], rows=len(theta), **options)
    valid = torch.isfinite(theta).all(dim=1) & readable(x.to(like))
    if not valid.any():
        raise SimulationError("All stored simulations contain NaN or Inf.")
    check_in_support("simulations[0]", theta[valid], prior)
    stored = Stored(theta[valid], x[valid].to(like))
    stored.num_dropped = _warn_of_dropped(valid, "stored simulations")
    return stored


@dataclass(frozen=True, eq=False, kw_only=True)
class Moments(Rows):
    """The moments of embeddings of simulations at the parameters of pairs.

    Attributes:
        means: Means at R parameters that the label of each pair leaves possible, shape
            ``(n, R, l)``, float64. R is 1 if all labels are exact.
        covariance: That of simulations at one parameter, ``(n, l, l)``, float64.
    """

    means: Tensor
    covariance: Tensor

    @property
    def mean(self) -> Tensor:
        """The mean over the possible parameters, shape ``(n, l)``."""
        return self.means.mean(dim=1)

    def columns(self, columns: slice) -> "Moments":
        """Return the moments of some entries of the embeddings."""
        means, covariance = self.means, self.covariance
        return Moments(
            means=means[..., columns], covariance=covariance[:, columns, columns]
        )


def draws(
    source: Source, pairs: Pairs, count: int, embed: Embed, *, progress: bool = False
) -> tuple[Tensor, Tensor]:
    """Return parameters ``(n, S, d)`` and embeddings ``(n, S, l)``, S at least count.

    A simulation that failed is replaced by another one of the pair.
    """
    theta = pairs.theta.repeat(1, -(-count // pairs.theta.shape[1]), 1)
    z = source.at(theta, embed, progress=progress)
    is_there = ~z.isnan().all(dim=2)
    if is_there.all():
        return theta, z
    # The k-th that failed is replaced by the k-th that is there.
    rows = (~is_there).int().argsort(dim=1, stable=True)
    k = is_there.cumsum(dim=1).where(is_there, (~is_there).cumsum(dim=1)) - 1
    chosen = rows.gather(1, k % is_there.sum(dim=1, keepdim=True))[..., None]
    return theta.take_along_dim(chosen, 1), z.take_along_dim(chosen, 1)


def targets(
    source: Source, pairs: Pairs, count: int, embed: Embed, *, progress: bool = False
) -> Tensor:
    r"""Return :math:`E[h(S(\theta)) \mid y_i]`, the mean of ``count`` simulations.

    Its shape is ``(n, l)``. Over labels that are not exact it averages parameters, too.
    """
    theta = pairs.theta[:, torch.arange(count) % pairs.theta.shape[1]]
    return source.at(theta, embed, progress=progress).nanmean(dim=1)


def moments(
    source: Source, pairs: Pairs, count: int, embed: Embed, *, progress: bool = False
) -> Moments:
    r"""Return the moments of simulations at the parameters of each pair.

    At exact parameters these are the moments of ``count`` simulations. Otherwise a
    surface is fitted to simulations at the draws of a label, linear or, with enough
    draws, quadratic. Its values at the draws are the possible means, and the covariance
    is that of the residuals. Its linear and its quadratic terms are shrunk by how much
    of their size is noise (James and Stein, Estimation with Quadratic Loss, 1961).
    """
    theta, simulated = draws(source, pairs, count, embed, progress=progress)
    simulated = simulated.double()
    means = simulated.mean(dim=1, keepdim=True)
    residual = simulated - means
    freedom = simulated.new_full((len(theta),), theta.shape[1] - 1)
    fits = []
    for terms in [] if pairs.theta.shape[1] == 1 else _features(theta.double()):
        fitted, used = _regressed(residual, terms)
        residual, freedom = residual - fitted, freedom - used
        fits.append((fitted, used))
    covariance = residual.mT @ residual / freedom.clamp_min(1.0)[:, None, None]
    noise = covariance.mean(dim=0).diagonal()
    for fitted, used in fits:
        squares = fitted.square().sum(dim=1)
        kept = 1 - used[:, None] * noise / squares.clamp_min(1e-300)
        means = means + fitted * kept.clamp_min(0.0)[:, None]
    return Moments(means=means, covariance=covariance)


def _features(theta: Tensor) -> list[Tensor]:
    """Return linear and, with enough draws, quadratic terms of standardised draws.

    All terms have mean zero, shape ``(n, R, p)``, and quadratic ones have no linear
    part. Parameters that are known exactly have terms of zero.
    """
    centred = theta - theta.mean(dim=1, keepdim=True)
    std = centred.square().mean(dim=1, keepdim=True).sqrt()
    scale = theta.abs().amax(dim=1, keepdim=True).clamp_min(1e-30)
    linear = torch.where(std > 1e-6 * scale, centred / std.clamp_min(1e-30), 0.0)
    first, second = torch.triu_indices(*[theta.shape[2]] * 2).to(theta.device)
    num_terms = theta.shape[2] + len(first)
    if num_terms * SIMULATIONS_PER_COEFFICIENT > theta.shape[1]:
        return [linear]
    quadratic = linear[..., first] * linear[..., second]
    quadratic = quadratic - quadratic.mean(dim=1, keepdim=True)
    return [linear, quadratic - _regressed(quadratic, linear)[0]]


def _regressed(y: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
    """Return the part of y linear in terms, and how many were fitted, ``(n,)``."""
    ridge = RIDGE * terms.shape[1] * torch.eye(terms.shape[2]).to(terms)
    normal = terms.mT @ terms
    used = torch.linalg.solve(normal + ridge, normal).diagonal(dim1=1, dim2=2)
    return terms @ torch.linalg.solve(normal + ridge, terms.mT @ y), used.sum(dim=1)
