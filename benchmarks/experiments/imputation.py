"""How long does it take to fit the discrepancy of labels that are not exact?

The table of "Labels that are not exact: how fast" of `benchmarks/speed.md`. Every row
is a process of its own. With ``--before`` each row is measured on another checkout of
the package too, in turns; compare within a run. The last columns show whether both
find the same: the mean gain of the first statistic, and its standard deviation.

    python -m benchmarks.experiments.imputation --before ../old-checkout
"""

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator
from typing import Any

import torch

from benchmarks.experiments.common import BEFORE, Row, begin, measured, show, versions

COLUMNS = ("pairs", "statistics", "repeat", "version", "CPU s", "gain", "its std")
OPTIONS = {
    "--n-calibration": {"type": int, "nargs": "+", "default": [50, 200]},
    "--width": {"type": int, "nargs": "+", "default": [4, 20], "help": "statistics"},
    "--repeats": {"type": int, "default": 2},
    **BEFORE,
}
# The parameters that a label leaves possible.
NUM_POSSIBLE = 100


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row for each number of statistics and pairs, repetition and version."""
    for width, pairs, repeat in itertools.product(
        args.width, args.n_calibration, range(args.repeats)
    ):
        for version, root in versions(args.before).items():
            settings = {"pairs": pairs, "statistics": width, "repeat": repeat}
            settings |= {"version": version, "root": root, "threads": args.threads}
            row = settings | measured("imputation", settings)
            yield {column: row[column] for column in COLUMNS}


def measure(settings: dict[str, Any]) -> None:
    """Measure a fit with the package of a checkout and print it as JSON."""
    sys.path.insert(0, settings["root"])
    from sbi_rope.discrepancy import DiscrepancyModel

    torch.set_num_threads(settings["threads"])
    torch.manual_seed(0)
    n, width = settings["pairs"], settings["statistics"]
    mean = torch.randn(n, 1, width)
    possible = mean + 0.3 * torch.randn(n, NUM_POSSIBLE, width)
    z = 0.8 * possible[:, 0] + 0.3 + 0.1 * torch.randn(n, width)
    noise = 0.05 * torch.eye(width)
    start = time.process_time()
    found = DiscrepancyModel().fit(z, possible, noise, seed=settings["repeat"])
    seconds = time.process_time() - start
    gain = found.sample(4000, seed=0).gain[:, 0, 0]
    row = {"CPU s": seconds, "gain": float(gain.mean()), "its std": float(gain.std())}
    print(json.dumps({name: f"{value:.2f}" for name, value in row.items()}))


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        measure(json.loads(sys.argv[1]))
    else:
        show(rows(begin(__doc__, OPTIONS, threads=1)))
