"""How long does it take to train all candidates of a stack?

The tables of "A stack: how fast" of `benchmarks/speed.md`. Every row is a process of
its own. With ``--before`` each row is measured on another checkout of the package too,
in turns; compare within a run. The last column is the density that the stack gives to
its own pairs: it shows whether all rows train the same networks.

    python -m benchmarks.experiments.stacking --before ../old-checkout
"""

import argparse
import itertools
import json
import sys
import time
import warnings
from collections.abc import Iterator
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import Tensor, nn

from benchmarks.experiments.common import BEFORE, Row, begin, measured, show, versions

COLUMNS = (
    *("estimator", "pairs", "repeat", "version", "CPU s", "s"),
    "mean log density",
)
OPTIONS = {
    "--estimator": {"nargs": "+", "default": ["mdn", "nsf"]},
    "--n-calibration": {"type": int, "default": 20},
    "--repeats": {"type": int, "default": 2},
    **BEFORE,
}
PRIOR = BoxUniform(-torch.ones(2), torch.ones(2))


def simulate(theta: Tensor) -> Tensor:
    """Return six noisy nonlinear readings of theta."""
    directions = torch.cos(torch.arange(12.0)).reshape(2, 6)
    return torch.tanh(theta @ directions) + 0.2 * torch.randn(len(theta), 6)


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row for each estimator, repetition and version."""
    for estimator, repeat, (version, root) in itertools.product(
        args.estimator, range(args.repeats), versions(args.before).items()
    ):
        settings = {"estimator": estimator, "pairs": args.n_calibration}
        settings |= {"repeat": repeat, "version": version, "root": root}
        settings |= {"threads": args.threads}
        row = settings | measured("stacking", settings)
        yield {column: row[column] for column in COLUMNS}


def measure(settings: dict[str, Any]) -> None:
    """Measure a stack with the package of a checkout and print it as JSON."""
    sys.path.insert(0, settings["root"])
    from sbi_rope import RoPE, stack

    warnings.simplefilter("ignore")
    torch.set_num_threads(settings["threads"])
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(6, 20), nn.ReLU(), nn.Linear(20, 4))
    build = posterior_nn(settings["estimator"], embedding_net=net)
    npe = NPE(PRIOR, density_estimator=build, show_progress_bars=False)
    theta = PRIOR.sample((2000,))
    npe.append_simulations(theta, simulate(theta)).train(max_num_epochs=20)
    theta = PRIOR.sample((settings["pairs"],))
    x = 1.1 * simulate(theta) + 0.1
    rope = RoPE(npe.build_posterior(), simulator=simulate)
    rope.append_calibration(theta, x)
    start, start_cpu = time.perf_counter(), time.process_time()
    posterior = stack(rope, seed=0, show_progress_bars=False)
    seconds = time.perf_counter() - start
    of_cpu = f"{time.process_time() - start_cpu:.0f}"
    log_probs = posterior.log_prob_batched(theta[None], x, norm_posterior=False)
    density = f"{float(log_probs.mean()):.6f}"
    times = {"CPU s": of_cpu, "s": f"{seconds:.0f}"}
    print(json.dumps({**times, "mean log density": density}))


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        measure(json.loads(sys.argv[1]))
    else:
        show(rows(begin(__doc__, OPTIONS, threads=1)))
