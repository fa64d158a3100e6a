"""How long does the mixture take: densities, samples, and one observation at a time?

The table "The mixture: how fast" of `benchmarks/speed.md`. Every row is a process of
its own; its memory is that of the whole process, most of it Python, torch and sbi.
With ``--before`` each row is measured on another checkout of the package too, in turns;
compare within a run.

    python -m benchmarks.experiments.mixture
    python -m benchmarks.experiments.mixture --before ../old-checkout --theta-dim 2
"""

import argparse
import itertools
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.experiments.common import BEFORE, Row, begin, measured, show, versions
from benchmarks.machine import forget_peak, memory, peak_memory

X_DIM = 10
COLUMNS = {
    "version": "version",
    "estimator": "estimator",
    "d": "theta_dim",
    "threads": "threads",
    "median ESS": "ess",
    "log_prob s": "log_prob",
    "samples s": "samples",
    "total s": "total",
    "memory before MB": "memory_start",
    "peak log_prob MB": "memory_log_prob",
    "peak samples MB": "memory_samples",
    "row ms": "row",
    "row + log_prob ms": "row_log_prob",
    "row + 1000 samples ms": "row_samples",
}


def simulate(theta: Tensor) -> Tensor:
    """Return ten noisy nonlinear readings of theta."""
    numbers = torch.arange(theta.shape[1] * X_DIM).reshape(-1, X_DIM)
    return torch.tanh(theta @ torch.cos(numbers)) + 0.2 * torch.randn(len(theta), X_DIM)


def prior_of(dim: int) -> BoxUniform:
    """Return a bounded prior, so that normalising and rejecting take part."""
    return BoxUniform(-torch.ones(dim), torch.ones(dim))


def trained_npe(estimator: str, dim: int) -> Any:
    """Train for a few epochs: the cost does not depend on the weights."""
    warnings.simplefilter("ignore")
    torch.manual_seed(0)
    npe = NPE(
        prior_of(dim),
        density_estimator=posterior_nn(estimator),
        show_progress_bars=False,
    )
    theta = prior_of(dim).sample((5000,))
    npe.append_simulations(theta, simulate(theta)).train(max_num_epochs=3)
    return npe.build_posterior()


OPTIONS = {
    "--theta-dim": {"type": int, "nargs": "+", "default": [2, 4]},
    "--estimator": {"nargs": "+", "default": ["nsf"]},
    "--n-o": {"type": int, "default": 2000},
    "--n-s": {"type": int, "default": 2000},
    "--num-samples": {"type": int, "default": 5000},
    "--num-single": {"type": int, "default": 200},
    "--gamma": {"type": float, "default": 0.5},
    "--tau": {"type": float, "default": 0.9},
    "--repeats": {"type": int, "default": 1},
    **BEFORE,
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row for each dimension, version and repetition."""
    print(
        f"{args.n_o} observations, {args.n_s} components, {args.num_samples} samples "
        f"each, gamma {args.gamma}, tau {args.tau}\n"
    )
    for estimator, dim in itertools.product(args.estimator, args.theta_dim):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "npe.pt"
            # Of sbi alone: it can be read whatever the version of this package.
            torch.save(trained_npe(estimator, dim), path)
            for _, (name, root) in itertools.product(
                range(args.repeats), versions(args.before).items()
            ):
                settings = vars(args) | {"theta_dim": dim, "estimator": estimator}
                settings |= {"npe": path, "root": root, "version": name}
                row = settings | measured("mixture", settings)
                yield {column: row[key] for column, key in COLUMNS.items()}


def measure(settings: dict[str, Any]) -> None:
    """Measure a cell with the package of a checkout and print it as JSON."""
    sys.path.insert(0, settings["root"])
    from sbi_rope import RoPE, SinkhornCoupler

    warnings.simplefilter("ignore")
    torch.set_num_threads(settings["threads"])
    npe = torch.load(settings["npe"], weights_only=False)  # written by this command
    torch.manual_seed(1)
    theta = npe.prior.sample((settings["n_o"],))
    x_o = 1.1 * simulate(theta) + 0.1
    rope = RoPE(npe, simulator=simulate)
    posterior = rope.build_posterior(
        x_o,
        coupler=SinkhornCoupler(
            gamma=settings["gamma"], tau=settings["tau"], cost_scale="none"
        ),
        num_simulations=settings["n_s"],
        seed=0,
    )
    ess = posterior.coupling.effective_sample_size.median()
    cell: dict[str, float] = {"ess": round(float(ess)), "memory_start": round(memory())}
    forget_peak()
    cell["log_prob"] = round(seconds(posterior.log_prob_batched, theta, x_o), 2)
    cell["memory_log_prob"] = round(peak_memory())
    forget_peak()
    shape = (settings["num_samples"],)
    draw = partial(posterior.sample_batched, show_progress_bars=False)
    cell["samples"] = round(seconds(draw, shape, x_o), 2)
    cell["memory_samples"] = round(peak_memory())
    cell["total"] = round(cell["log_prob"] + cell["samples"], 2)

    new = itertools.cycle(x_o)
    net = rope.embedding_net
    calls: dict[str, Callable[[Tensor], Tensor]] = {
        "row": lambda x: posterior.coupling.rows(net(x[None])),
        "row_log_prob": lambda x: posterior.log_prob(theta[:1], x=x),
        "row_samples": lambda x: posterior.sample((1000,), x, show_progress_bars=False),
    }
    for name, call in calls.items():
        taken = [seconds(call, next(new)) for _ in range(settings["num_single"])]
        cell[name] = round(1000 * sum(taken) / len(taken), 2)
    print(json.dumps(cell))


def seconds(call: Callable[..., object], *arguments: object) -> float:
    """Return how long a call takes."""
    start = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - start


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        measure(json.loads(sys.argv[1]))
    else:
        show(rows(begin(__doc__, OPTIONS)))
