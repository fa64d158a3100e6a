"""Our coupling's solver, that of POT and that of OTT-JAX, called in the same way."""

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import ot
import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost
from sbi_rope.coupling.fixed_point import Solution, solve_fixed_point
from sbi_rope.coupling.kernel import Kernel, marginal_error

TOLERANCE = 1e-6


class Outcome(NamedTuple):
    """What a solver returned: rows of the plan, its column potential, iterations."""

    rows: Any
    potential: Tensor
    num_iterations: int


Solver = Callable[[], Outcome]


def solved(cost: Cost, gamma: float, tau: float, *, memory: int = 5) -> Solution:
    """Solve from stored distances to a potential with our own core."""
    return solve_fixed_point(
        Kernel(cost, gamma, stored=True),
        torch.zeros(cost.shape[1], dtype=torch.float64),
        tau=tau,
        tolerance=TOLERANCE,
        max_iterations=10_000,
        memory=memory,
        eps=torch.finfo(cost.real.dtype).eps,
    )


def own(cost: Cost, gamma: float, tau: float, *, memory: int = 5) -> Outcome:
    """Solve from stored distances to rows with our own core."""
    solution = solved(cost, gamma, tau, memory=memory)
    rows = rows_of(solution.potential, cost, gamma)
    return Outcome(rows, solution.potential, solution.num_iterations)


def rows_of(potential: Tensor, cost: Cost, gamma: float) -> Tensor:
    """Turn a potential into rows, as the package does."""
    weights = cost.real.new_empty(cost.shape)
    w = potential.to(weights)
    for rows in cost.row_blocks():
        weights[rows] = torch.add(w, cost.block(rows), alpha=-1 / gamma).softmax(dim=1)
    return weights


def pot(
    cost: Cost,
    gamma: float,
    tau: float,
    *,
    method: str = "sinkhorn",
    numpy: bool = True,
    cut: int | None = None,
) -> Outcome:
    """Run POT with its own stopping rule, or cut after some iterations.

    As shipped, its own plan is the result; cut, the rows come from its potential.
    """
    n_o, n_s = cost.shape
    distances: Any = cost.block(slice(None))
    a, b = distances.new_full((n_o,), 1 / n_o), distances.new_full((n_s,), 1 / n_s)
    if numpy:
        a, b, distances = a.numpy(), b.numpy(), distances.numpy()
    stopping = {} if cut is None else {"numItermax": cut, "stopThr": 0.0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plan, log = ot.unbalanced.sinkhorn_unbalanced(
            a,
            b,
            distances,
            gamma,
            (math.inf, math.inf if tau == 1.0 else gamma * tau / (1 - tau)),
            method=method,
            log=True,
            **stopping,
        )
    potential = torch.as_tensor(log["logv"]).double()
    if cut is not None:
        plan = rows_of(potential, cost, gamma)
    return Outcome(plan, potential, len(log["err"]))


def ott(cost: Cost, gamma: float, tau: float) -> Solver | None:
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
        matrix, g, iterations = jax.block_until_ready(solve(distances))
        potential = torch.tensor(g.tolist(), dtype=torch.float64) / gamma
        return Outcome(matrix, potential - potential.mean(), int(iterations))

    run()  # compilation is not measured
    return run


def error_of(outcome: Outcome, cost: Cost, gamma: float, tau: float) -> float:
    """Return the marginal error of a potential, in float64 whatever the solver."""
    if not torch.isfinite(outcome.potential).all():
        return math.nan
    cost = Cost(cost.real.double(), cost.simulated.double(), stored=False)
    potential = outcome.potential - outcome.potential.mean()
    log_q = Kernel(cost, gamma, stored=False)(potential)
    return marginal_error(log_q, potential, tau)


def iterations_for_accuracy(cost: Cost, gamma: float, tau: float) -> int:
    """Return how many of POT's iterations reach the tolerance, by our error."""
    plain = own(cost, gamma, tau, memory=0).num_iterations
    kernel = Kernel(cost, gamma, stored=True)
    while plain < 10_000:
        potential = pot(cost, gamma, tau, cut=plain).potential
        potential = potential - potential.mean()
        if not marginal_error(kernel(potential), potential, tau) > TOLERANCE:
            break
        plain += 1 + plain // 50
    return plain
