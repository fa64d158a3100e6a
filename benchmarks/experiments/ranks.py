"""What would recalibration of stacks gain if its map were chosen on the test set?

Recalibration sees where held-out parameters lie in their posteriors. This reads from
committed results where those of the test set lie: at which levels of central intervals,
averaged over parameters. "factor" is the factor of the spread that a normal posterior
would need, "its gain" what it adds to the log density of a parameter, and "any map"
what the best monotone map of the levels adds, if it may choose the share of each of ten
bins. All are means over variants and repetitions. Up to .005 of "any map" is noise.

    python -m benchmarks.experiments.ranks --suite stacking main
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from benchmarks.cells import load_suite
from benchmarks.experiments.common import Row, begin, show
from benchmarks.table import read_table

RESULTS = Path(__file__).parents[1] / "results"
OPTIONS = {
    "--suite": {"nargs": "+", "default": ["stacking", "main"]},
    "--method": {"default": "stack"},
}
# The coverage is known at 99 levels; it is put into ten bins, so that there are enough
# parameters in each.
EVERY = 10
LEVELS = np.linspace(0.0, 1.0, EVERY + 1)
MEASURED = ("acauc", "factor", "its gain", "any map")


def gain_of_any_map(shares: np.ndarray) -> float:
    """Return the divergence of some shares of equal bins from equal shares, in nats."""
    shares = shares[shares > 0.0]
    return float(shares @ np.log(shares * EVERY))


def gain_of_factor(shares: np.ndarray, factor: float) -> float:
    """Return what a factor adds to a normal density, with parameters in these bins."""
    edges = 2.0 * norm.cdf(norm.ppf((1.0 + LEVELS) / 2.0) / factor) - 1.0
    return float(shares @ np.log(np.diff(edges) * EVERY))


def best_factor(shares: np.ndarray) -> float:
    """Return the factor that adds most."""
    found = minimize_scalar(
        lambda log_factor: -gain_of_factor(shares, float(np.exp(log_factor))),
        bounds=(-1.5, 1.5),
        method="bounded",
    )
    return float(np.exp(found.x))


def shares_of(coverage: np.ndarray) -> np.ndarray:
    """Return the shares of parameters in the bins, from the coverage at 99 levels."""
    return np.diff(coverage[EVERY - 1 :: EVERY], prepend=0.0, append=1.0)


def rows_of(args: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each task and number of pairs of the suites."""
    for name in args.suite:
        table = read_table(load_suite(name), RESULTS / name)
        found: dict[tuple[str, int], list[tuple[float, ...]]] = {}
        finished = table.finished
        rows = finished[finished["method"] == args.method]
        for cell, acauc in zip(rows.index, rows["acauc"], strict=True):
            shares = shares_of(table.arrays[cell]["coverage"].astype(float))
            factor = best_factor(shares)
            gains = gain_of_factor(shares, factor), gain_of_any_map(shares)
            of_task = found.setdefault((cell.task, cell.n_calibration), [])
            of_task.append((acauc, factor, *gains))
        for (task, pairs), measured in found.items():
            means = np.mean(measured, axis=0)
            head = {
                "suite": name,
                "task": task,
                "pairs": pairs,
                "stacks": len(measured),
            }
            yield head | {
                column: f"{mean:.3f}"
                for column, mean in zip(MEASURED, means, strict=True)
            }


def main() -> None:
    """Print the table."""
    show(rows_of(begin(__doc__, OPTIONS)))


if __name__ == "__main__":
    main()
