"""How fast is the coupling, side by side with POT and OTT-JAX?

From embeddings to rows, as in "The coupling: how fast" of `benchmarks/speed.md`: our
coupler with its defaults, and distances that are handed to the others as they are
shipped. Seconds are the smallest of several repetitions, in which the solvers of a
problem take turns; compare within a problem. The error is the marginal error of the
potential, by one function in float64 for all.

    python -m benchmarks.coupling_speed
    python -m benchmarks.coupling_speed --n 5000 --repeats 2
"""

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import ot
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling.sinkhorn import marginal_error

SETTINGS = [(0.5, 0.9), (0.5, 1.0), (0.05, 0.9), (0.05, 1.0)]
# Returns the iterations and the marginal error.
Solver = Callable[[Tensor, Tensor], tuple[int, float]]


def embeddings(n: int) -> tuple[Tensor, Tensor]:
    """Return n misspecified observations and n simulations in ten dimensions."""
    generator = torch.Generator().manual_seed(0)
    simulated = torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real = 1.3 * torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real[:, 0] += 1.0
    real[: n // 10] += 2.0
    return real, simulated


def own(gamma: float, tau: float, real: Tensor, simulated: Tensor) -> tuple[int, float]:
    """Couple with our own coupler."""
    coupler = SinkhornCoupler(gamma=gamma, tau=tau, cost_scale="none")
    coupling = coupler.couple(real, simulated)
    return coupling.num_iterations, coupling.marginal_error


def pot(gamma: float, tau: float, real: Tensor, simulated: Tensor) -> tuple[int, Any]:
    """Compute distances and hand them to POT, as arrays of NumPy."""
    distances = torch.cdist(real, simulated)
    n_o, n_s = distances.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, log = ot.unbalanced.sinkhorn_unbalanced(
            distances.new_full((n_o,), 1 / n_o).numpy(),
            distances.new_full((n_s,), 1 / n_s).numpy(),
            distances.numpy(),
            gamma,
            (math.inf, math.inf if tau == 1.0 else gamma * tau / (1 - tau)),
            log=True,
        )
    return len(log["err"]), torch.as_tensor(log["logv"])


def ott(gamma: float, tau: float, jax: Any) -> Solver:
    """Return OTT-JAX's Sinkhorn solver, compiled."""
    from ott.geometry import geometry
    from ott.problems.linear import linear_problem
    from ott.solvers.linear import sinkhorn

    jax.config.update("jax_enable_x64", val=True)

    @jax.jit
    def solve(distances: Any) -> Any:
        geom = geometry.Geometry(cost_matrix=distances, epsilon=gamma)
        problem = linear_problem.LinearProblem(geom, tau_a=1.0, tau_b=tau)
        out = sinkhorn.Sinkhorn(max_iterations=10_000)(problem)
        return out.matrix, out.g, out.n_iters

    def run(real: Tensor, simulated: Tensor) -> tuple[int, Any]:
        distances = jax.numpy.asarray(torch.cdist(real, simulated).numpy())
        _, g, iterations = jax.block_until_ready(solve(distances))
        return int(iterations), torch.tensor(g.tolist()).double() / gamma

    return run


def error_of(potential: Any, points: tuple[Tensor, Tensor], setting: Any) -> float:
    """Return the marginal error of a potential; our coupler tells its own."""
    if not isinstance(potential, Tensor):
        return potential
    if not torch.isfinite(potential).all():
        return math.nan
    gamma, tau = setting
    w = potential - potential.mean()
    rows = (w - torch.cdist(*points) / gamma).log_softmax(dim=1)
    return marginal_error(rows.logsumexp(dim=0) - math.log(len(rows)), w, tau)


def rows(sizes: Sequence[int], repeats: int) -> Iterator[dict[str, object]]:
    """Yield a row for each problem and solver."""
    try:
        import jax
    except ImportError:
        jax = None
    for n, setting in itertools.product(sizes, SETTINGS):
        points = embeddings(n)
        solvers: dict[str, Any] = {"own": partial(own, *setting)}
        solvers["POT (numpy)"] = partial(pot, *setting)
        if jax is not None:
            solvers["OTT-JAX"] = ott(*setting, jax)
            solvers["OTT-JAX"](*points)  # compilation is not measured
        seconds = dict.fromkeys(solvers, math.inf)
        found: dict[str, tuple[int, Any]] = {}
        for _, name in itertools.product(range(repeats), solvers):
            start = time.perf_counter()
            found[name] = solvers[name](*points)
            seconds[name] = min(seconds[name], time.perf_counter() - start)
        for name, (iterations, potential) in found.items():
            yield {
                **{"n": n, "gamma": setting[0], "tau": setting[1], "solver": name},
                "iterations": iterations,
                "error": f"{error_of(potential, points, setting):.0e}",
                "ms": f"{1e3 * seconds[name]:.1f}",
                "x own": f"{seconds[name] / seconds['own']:.2f}",
            }


def main() -> None:
    """Print a table in Markdown, each row when it is there."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    versions = ", ".join(f"{one.__name__} {one.__version__}" for one in (torch, ot))
    print(f"{args.threads} thread(s), {versions}\n")
    for number, row in enumerate(rows(args.n, args.repeats)):
        if number == 0:
            print(f"| {' | '.join(row)} |\n{'|---' * len(row)}|")
        print(f"| {' | '.join(map(str, row.values()))} |", flush=True)


if __name__ == "__main__":
    main()
