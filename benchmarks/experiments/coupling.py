"""How fast is the coupling solved, side by side with POT and OTT-JAX?

The first table of "The coupling: how fast" in `benchmarks/speed.md`. Seconds are the
smallest of several repetitions, in which the solvers of a problem take turns; compare
within a problem. The error is the marginal error of the potential, computed by one
function in float64 for all.

    python -m benchmarks.experiments.coupling
    python -m benchmarks.experiments.coupling --n 5000 --dtypes float64 --repeats 2
"""

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import ot
import torch
from torch import Tensor

from benchmarks.experiments.common import Row, begin, show
from sbi_rope.coupling.cost import Cost
from sbi_rope.coupling.fixed_point import solve_fixed_point
from sbi_rope.coupling.kernel import Kernel, marginal_error

SETTINGS = [(0.5, 0.9), (0.5, 1.0), (0.05, 0.9), (0.05, 1.0)]
DTYPES = {"float64": torch.float64, "float32": torch.float32}
OPTIONS = {
    "--n": {"type": int, "nargs": "+", "default": [500, 2000]},
    "--dtypes": {"nargs": "+", "choices": DTYPES, "default": [*DTYPES]},
    "--repeats": {"type": int, "default": 5},
}


class Outcome(NamedTuple):
    """The column potential that a solver found, and its iterations."""

    potential: Tensor
    num_iterations: int


def embeddings(n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return n misspecified observations and n simulations in ten dimensions."""
    generator = torch.Generator().manual_seed(0)
    simulated = torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real = 1.3 * torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real[:, 0] += 1.0
    real[: n // 10] += 2.0
    return real.to(dtype), simulated.to(dtype)


def own(cost: Cost, gamma: float, tau: float) -> Outcome:
    """Solve from stored distances to rows with our own core."""
    solution = solve_fixed_point(
        Kernel(cost, gamma, stored=True),
        torch.zeros(cost.shape[1], dtype=torch.float64),
        tau=tau,
        tolerance=1e-6,
        max_iterations=10_000,
        memory=5,
        eps=torch.finfo(cost.real.dtype).eps,
    )
    w = solution.potential.to(cost.real)
    weights = cost.real.new_empty(cost.shape)
    for rows in cost.row_blocks():
        weights[rows] = torch.add(w, cost.block(rows), alpha=-1 / gamma).softmax(dim=1)
    return Outcome(solution.potential, solution.num_iterations)


def pot(cost: Cost, gamma: float, tau: float) -> Outcome:
    """Run POT on arrays of NumPy, with its own stopping rule."""
    n_o, n_s = cost.shape
    distances = cost.block(slice(None))
    a, b = distances.new_full((n_o,), 1 / n_o), distances.new_full((n_s,), 1 / n_s)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, log = ot.unbalanced.sinkhorn_unbalanced(
            a.numpy(),
            b.numpy(),
            distances.numpy(),
            gamma,
            (math.inf, math.inf if tau == 1.0 else gamma * tau / (1 - tau)),
            log=True,
        )
    return Outcome(torch.as_tensor(log["logv"]).double(), len(log["err"]))


def ott(cost: Cost, gamma: float, tau: float) -> Callable[[], Outcome] | None:
    """Return OTT-JAX's Sinkhorn solver, compiled, if it is installed."""
    try:
        import jax
        from ott.geometry import geometry
        from ott.problems.linear import linear_problem
        from ott.solvers.linear import sinkhorn
    except ImportError:
        return None
    if cost.real.dtype == torch.float64:
        jax.config.update("jax_enable_x64", val=True)
    distances = jax.numpy.asarray(cost.block(slice(None)).numpy())

    @jax.jit
    def solve(distances: Any) -> Any:
        geom = geometry.Geometry(cost_matrix=distances, epsilon=gamma)
        problem = linear_problem.LinearProblem(geom, tau_a=1.0, tau_b=tau)
        out = sinkhorn.Sinkhorn(max_iterations=10_000)(problem)
        return out.matrix, out.g, out.n_iters

    def run() -> Outcome:
        _, g, iterations = jax.block_until_ready(solve(distances))
        potential = torch.tensor(g.tolist(), dtype=torch.float64) / gamma
        return Outcome(potential, int(iterations))

    run()  # compilation is not measured
    return run


def error_of(outcome: Outcome, cost: Cost, gamma: float, tau: float) -> float:
    """Return the marginal error of a potential, in float64 whatever the solver."""
    potential = outcome.potential - outcome.potential.mean()
    if not torch.isfinite(potential).all():
        return math.nan
    cost = Cost(cost.real.double(), cost.simulated.double(), stored=False)
    return marginal_error(Kernel(cost, gamma, stored=False)(potential), potential, tau)


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each problem and solver."""
    for n, name, (gamma, tau) in itertools.product(args.n, args.dtypes, SETTINGS):
        cost = Cost(*embeddings(n, DTYPES[name]), stored=True)
        by_ott = ott(cost, gamma, tau)
        solvers: dict[str, Callable[[], Outcome]] = {
            "own": lambda: own(cost, gamma, tau),  # noqa: B023
            "POT sinkhorn as shipped (numpy)": lambda: pot(cost, gamma, tau),  # noqa: B023
        } | ({} if by_ott is None else {"OTT-JAX as shipped": by_ott})
        seconds = dict.fromkeys(solvers, math.inf)
        outcomes: dict[str, Outcome] = {}
        for _, solver in itertools.product(range(args.repeats), solvers):
            start = time.perf_counter()
            outcomes[solver] = solvers[solver]()
            seconds[solver] = min(seconds[solver], time.perf_counter() - start)
        for solver, outcome in outcomes.items():
            error = error_of(outcome, cost, gamma, tau)
            yield {
                **{"n": n, "dtype": name, "gamma": gamma, "tau": tau},
                "solver": solver,
                "iterations": outcome.num_iterations,
                "error": "failed (NaN)" if math.isnan(error) else f"{error:.0e}",
                "ms": f"{1e3 * seconds[solver]:.1f}",
                "x own": f"{seconds[solver] / seconds['own']:.2f}",
            }


if __name__ == "__main__":
    show(rows(begin(__doc__, OPTIONS, threads=1)))
