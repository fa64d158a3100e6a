"""How fast is the coupling solved, side by side with POT and OTT-JAX?

The tables of "The coupling: how fast" in `benchmarks/speed.md`. Seconds are the
smallest of several repetitions, in which the competitors of a cell take turns; compare
within a cell, not across tables. Without an error there is no comparison: every row
shows the marginal error of its potential, computed by one and the same function in
float64.

    python -m benchmarks.experiments.coupling
    python -m benchmarks.experiments.coupling --sections solvers floor --n 500 2000
"""

import argparse
import itertools
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.experiments.common import Row, begin, show
from benchmarks.experiments.solvers import (
    Outcome,
    Solver,
    error_of,
    iterations_for_accuracy,
    ott,
    own,
    pot,
    solved,
)
from benchmarks.machine import peak_memory
from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling
from sbi_rope.coupling.cost import Cost

SETTINGS = [(0.5, 0.9), (0.5, 1.0), (0.05, 0.9), (0.05, 1.0)]
DTYPES = {"float64": torch.float64, "float32": torch.float32}


def embeddings(n: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return n misspecified observations and n simulations in ten dimensions."""
    generator = torch.Generator().manual_seed(0)
    simulated = torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real = 1.3 * torch.randn(n, 10, generator=generator, dtype=torch.float64)
    real[:, 0] += 1.0
    real[: n // 10] += 2.0
    return real.to(dtype), simulated.to(dtype)


def race(
    tasks: Mapping[str, Callable[[], Any]], repeats: int
) -> dict[str, tuple[float, Any]]:
    """Run tasks in turn; return the smallest seconds and the last result of each."""
    seconds = dict.fromkeys(tasks, math.inf)
    results: dict[str, Any] = {}
    for _ in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            result = task()
            seconds[name] = min(seconds[name], time.perf_counter() - start)
            # Memory that is held here would be missing where the next task runs.
            if isinstance(result, Outcome):
                result = result._replace(rows=None)
            results[name] = None if isinstance(result, Tensor) else result
            del result
    return {name: (seconds[name], results[name]) for name in tasks}


def repeats(args: argparse.Namespace, n: int) -> int:
    """Return how often to repeat: large problems are long enough to be steady."""
    return args.repeats if n <= 2000 else min(args.repeats, 2)


def problems(args: argparse.Namespace) -> Iterator[tuple[Cost, dict[str, Any]]]:
    """Yield stored distances, and settings to solve with."""
    for n, name, (gamma, tau) in itertools.product(args.n, args.dtypes, SETTINGS):
        cost = Cost(*embeddings(n, DTYPES[name]), stored=True)
        yield cost, {"n": n, "dtype": name, "gamma": gamma, "tau": tau}


# Sections: each yields the rows of a table --------------------------------------------


def compare_solvers(args: argparse.Namespace) -> Iterator[Row]:
    """From stored distances to rows: our own core, POT, OTT-JAX."""
    for cost, setting in problems(args):
        gamma, tau = setting["gamma"], setting["tau"]
        by_pot = partial(pot, cost, gamma, tau)
        solvers: dict[str, Solver] = {
            "own": partial(own, cost, gamma, tau),
            "own, not accelerated": partial(own, cost, gamma, tau, memory=0),
            "POT sinkhorn as shipped (numpy)": by_pot,
            "POT sinkhorn as shipped (torch)": partial(by_pot, numpy=False),
            "POT translation_invariant as shipped (numpy)": partial(
                by_pot, method="sinkhorn_translation_invariant"
            ),
        }
        cut = iterations_for_accuracy(cost, gamma, tau)
        if cut < 10_000:
            equal = partial(by_pot, cut=cut)
            solvers["POT sinkhorn cut at equal accuracy (numpy)"] = equal
        by_ott = ott(cost, gamma, tau)
        if by_ott is not None:
            solvers["OTT-JAX as shipped"] = by_ott
        results = race(solvers, repeats(args, setting["n"]))
        for key, (seconds, outcome) in results.items():
            error = error_of(outcome, cost, gamma, tau)
            yield {
                **setting,
                "solver": key,
                "iterations": outcome.num_iterations,
                "error": "failed (NaN)" if math.isnan(error) else f"{error:.0e}",
                "ms": f"{1e3 * seconds:.1f}",
                "x own": f"{seconds / results['own'][0]:.2f}",
            }


def from_embeddings_by_pot(
    real: Tensor, simulated: Tensor, gamma: float, tau: float, *, numpy: bool
) -> Tensor:
    """Compute distances and hand them to POT."""
    return pot(Cost(real, simulated, stored=True), gamma, tau, numpy=numpy).rows


def compare_default(args: argparse.Namespace) -> Iterator[Row]:
    """From embeddings to rows: the coupler with its defaults, and POT as shipped."""
    for n, (gamma, tau) in itertools.product(args.n, SETTINGS):
        points = embeddings(n, torch.float64)
        coupler = SinkhornCoupler(gamma=gamma, tau=tau, cost_scale="none")
        by_pot = partial(from_embeddings_by_pot, *points, gamma, tau)
        tasks = {
            "coupler": lambda c=coupler, p=points: c.couple(*p).weights,
            "numpy": partial(by_pot, numpy=True),
            "torch": partial(by_pot, numpy=False),
        }
        results = race(tasks, repeats(args, n))
        ms = {name: 1e3 * seconds for name, (seconds, _) in results.items()}
        yield {
            "n": n,
            "gamma": gamma,
            "tau": tau,
            "coupler ms": f"{ms['coupler']:.1f}",
            "distances + POT as shipped ms (numpy)": f"{ms['numpy']:.1f}",
            "(torch)": f"{ms['torch']:.1f}",
            "coupler / faster POT": (
                f"{ms['coupler'] / min(ms['numpy'], ms['torch']):.2f}"
            ),
        }


def products(matrix: Tensor, ones: Tensor) -> None:
    """Make the two matrix-vector products of an iteration, ten times."""
    for _ in range(10):
        matrix @ ones
        matrix.T @ ones


def compare_with_floor(args: argparse.Namespace) -> Iterator[Row]:
    """From stored distances to a potential: our own core, and the least it can cost."""
    for cost, setting in problems(args):
        n, distances = setting["n"], cost.block(slice(None))
        tasks = {
            "own": partial(solved, cost, setting["gamma"], setting["tau"]),
            # Into new memory, which the solver needs too.
            "exp": partial(torch.exp, distances),
            "gemv": partial(products, torch.exp(-distances), distances.new_ones(n)),
        }
        results = race(tasks, repeats(args, n) + 1)
        ms = {key: 1e3 * seconds for key, (seconds, _) in results.items()}
        iterations = results["own"][1].num_iterations
        floor = ms["exp"] + iterations * ms["gemv"] / 10
        yield {
            **setting,
            "iterations": iterations,
            "own ms": f"{ms['own']:.1f}",
            "exp pass ms": f"{ms['exp']:.1f}",
            "2 GEMVs ms": f"{ms['gemv'] / 10:.2f}",
            "floor ms": f"{floor:.1f}",
            "floor / own": f"{floor / ms['own']:.2f}",
        }


def one_by_one(
    coupler: SinkhornCoupler, points: tuple[Tensor, Tensor], grid: list[list[float]]
) -> list[Coupling]:
    """Couple at every gamma and tau, each time from the start."""
    return [
        replace(coupler, gamma=gamma, tau=tau).couple(*points)
        for gamma, tau in itertools.product(*grid)
    ]


def warm(
    coupler: SinkhornCoupler, points: tuple[Tensor, Tensor], grid: list[list[float]]
) -> list[Coupling]:
    """Couple at every gamma and tau by a sweep."""
    return list(coupler.sweep(*points, gammas=grid[0], taus=grid[1]))


def compare_sweeps(args: argparse.Namespace) -> Iterator[Row]:
    """Ten gammas times five taus: warm starts, cold starts, and the plain iteration."""
    gammas = torch.logspace(math.log10(5.0), math.log10(0.05), 10).tolist()
    grid = [gammas, [0.5, 0.7, 0.9, 0.99, 1.0]]
    for n, name in itertools.product(args.n, args.dtypes):
        points = embeddings(n, DTYPES[name])
        coupler = SinkhornCoupler(dtype=DTYPES[name], cost_scale="none")
        plain = replace(coupler, anderson_memory=0)
        tasks = {
            "own, warm": partial(warm, coupler, points, grid),
            "own, cold": partial(one_by_one, coupler, points, grid),
            "own, cold, not accelerated": partial(one_by_one, plain, points, grid),
        }
        results = race(tasks, 1 if n > 500 else args.repeats)
        for key, (seconds, couplings) in results.items():
            yield {
                "n": n,
                "dtype": name,
                "solver": key,
                "iterations": sum(one.num_iterations for one in couplings),
                "not converged of 50": sum(not one.converged for one in couplings),
                "s": f"{seconds:.2f}",
                "x warm": f"{seconds / results['own, warm'][0]:.2f}",
            }


def compare_memory(args: argparse.Namespace) -> Iterator[Row]:
    """Blocked and stored solutions, each in a process of its own."""
    columns = ("iterations", "error", "s", "peak memory beyond the inputs, MB")
    modes = ("blocked", "stored")
    for n, name, mode in itertools.product([*args.n, 20_000], args.dtypes, modes):
        values = ["not run", "", "", ""]
        if mode == "blocked" or n <= 10_000:
            command = [sys.executable, "-m", "benchmarks.experiments.coupling"]
            command += ["--threads", str(args.threads)]
            command += ["--measure", str(n), name, mode]
            run = subprocess.run(command, capture_output=True, text=True, check=True)
            values = run.stdout.splitlines()[-1].split()
        measured = dict(zip(columns, values, strict=True))
        yield {"n": n, "dtype": name, "mode": mode, **measured}


def measure(n: int, name: str, mode: str) -> None:
    """Couple once and print iterations, error, seconds and peak memory."""
    real, simulated = embeddings(n, DTYPES[name])
    coupler = SinkhornCoupler(
        gamma=0.5,
        tau=0.9,
        cost_scale="none",
        dtype=DTYPES[name],
        blocked=mode == "blocked",
    )
    coupler.couple(real[:100], simulated[:100])
    before = peak_memory()
    start = time.perf_counter()
    coupling = coupler.couple(real, simulated)
    seconds = time.perf_counter() - start
    print(
        f"{coupling.num_iterations} {coupling.marginal_error:.0e} {seconds:.2f} "
        f"{peak_memory() - before:.0f}"
    )


def compare_subsets(args: argparse.Namespace) -> Iterator[Row]:
    """Potentials fitted to some of 10,000 observations, 2000 simulations."""
    real, simulated = embeddings(10_000, torch.float64)
    simulated = simulated[:2000]
    for gamma, tau in [(0.5, 0.9), (0.1, 0.9)]:
        coupler = SinkhornCoupler(gamma=gamma, tau=tau, cost_scale="none")
        full = coupler.couple(real, simulated)
        for count in (500, 1000, 2000, 5000, 10_000):
            start = time.perf_counter()
            part = replace(coupler, num_fitted=count).couple(real, simulated, seed=0)
            seconds = time.perf_counter() - start
            distance = (part.weights - full.weights).abs().sum(dim=1) / 2
            yield {
                "gamma": gamma,
                "tau": tau,
                "fitted to": count,
                "s": f"{seconds:.2f}",
                "batch error": f"{part.batch_error:.1e}",
                "row TV to the full fit, mean": f"{float(distance.mean()):.3f}",
                "max": f"{float(distance.max()):.3f}",
            }


def check_extremes(args: argparse.Namespace) -> Iterator[Row]:
    """NaN, and what converged, over gamma / max(C), tau, dtype, solver and mode."""
    real, simulated = embeddings(500, torch.float64)
    largest = float(torch.cdist(real, simulated).max())
    modes = [("own", False), ("own", True), ("pot", False)]
    for ratio, (solver, blocked), name in itertools.product(
        [1.0, 1e-1, 1e-2, 3e-3, 1e-3], modes, args.dtypes
    ):
        couplings = [
            SinkhornCoupler(
                gamma=ratio * largest,
                tau=tau,
                cost_scale="none",
                solver=solver,
                blocked=blocked,
                dtype=DTYPES[name],
                max_iterations=3000,
            ).couple(real, simulated)
            for tau in (1.0, 0.99, 0.9, 0.5)
        ]
        yield {
            "gamma / max(C)": ratio,
            "mode": f"{solver} {name}{' blocked' * blocked}",
            "converged of 4 taus": sum(one.converged for one in couplings),
            "most iterations": max(one.num_iterations for one in couplings),
            "largest error": f"{max(one.marginal_error for one in couplings):.0e}",
            "NaN": sum(not torch.isfinite(one.weights).all() for one in couplings),
        }


SECTIONS = {
    "solvers": compare_solvers,
    "default": compare_default,
    "floor": compare_with_floor,
    "sweeps": compare_sweeps,
    "memory": compare_memory,
    "subsets": compare_subsets,
    "extremes": check_extremes,
}
OPTIONS = {
    "--sections": {"nargs": "+", "choices": SECTIONS, "default": [*SECTIONS]},
    "--n": {"type": int, "nargs": "+", "default": [500, 2000]},
    "--dtypes": {"nargs": "+", "choices": DTYPES, "default": [*DTYPES]},
    "--repeats": {"type": int, "default": 5},
    "--measure": {"nargs": 3, "help": argparse.SUPPRESS},
}


def main() -> None:
    """Print the sections asked for."""
    args = begin(__doc__, OPTIONS, threads=1)
    if args.measure:
        measure(int(args.measure[0]), *args.measure[1:])
        return
    for section in args.sections:
        print(f"\n{SECTIONS[section].__doc__}\n", flush=True)
        show(SECTIONS[section](args))


if __name__ == "__main__":
    main()
