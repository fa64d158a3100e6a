"""How should the embedding net be tuned: learning rate, steps, and targets?

The tables of "Tuning the embedding net" in `benchmarks/choices.md`. Every setting is
scored on labelled real observations of the calibration part that were not tuned on; the
test part is never touched. Runs are kept, so that the experiment can be interrupted.

    python -m benchmarks.experiments.finetuning --task pendulum
"""

import argparse
import itertools
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import NPE_SETTINGS, cache_of, labelled, trained_npe
from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.metrics import lpp
from sbi_rope.tasks import Task, get_task

# Fresh draws in the place of a bank of simulations.
FRESH = {"simulations_per_target": 1, "resample_targets": True}
SETTINGS: dict[str, dict[str, Any]] = {
    "paper: lr 1e-5, 1 fresh draw": {"learning_rate": 1e-5, **FRESH},
    "lr 1e-4, 1 fresh draw": {"learning_rate": 1e-4, **FRESH},
    "lr 1e-3, 1 fresh draw": {"learning_rate": 1e-3, **FRESH},
    "lr 1e-3, 10 fresh draws": {
        "learning_rate": 1e-3,
        **FRESH,
        "simulations_per_target": 10,
    },
    "lr 1e-3, bank of 1": {"learning_rate": 1e-3, "simulations_per_target": 1},
    "lr 1e-3, bank of 10": {"learning_rate": 1e-3, "simulations_per_target": 10},
    "lr 1e-4, bank of 100": {"learning_rate": 1e-4},
    "lr 3e-4, bank of 100": {"learning_rate": 3e-4},
    "lr 1e-3, bank of 100": {"learning_rate": 1e-3},
    "lr 3e-3, bank of 100": {"learning_rate": 3e-3},
    "lr 1e-3, bank of 100, 300 steps": {"learning_rate": 1e-3, "max_num_epochs": 300},
    "lr 1e-4, bank of 100, 3000 steps": {"learning_rate": 1e-4, "max_num_epochs": 3000},
    "defaults: better of lr 1e-4 and 1e-3, bank of 100, patience 200": {},
    "defaults, rehearsal 1": {"rehearsal": 1.0},
    "stored, 1 neighbour": {"num_neighbors": 1},
    "stored, 10 neighbours": {"num_neighbors": 10},
}
# Named learning rates run to their last step, so that they can be compared.
for _options in SETTINGS.values():
    if "learning_rate" in _options:
        _options["stop_after_epochs"] = 10_000
# Columns of the table, with the format of their means over seeds.
FORMATS = {
    "best step": ".0f",
    "distance": ".3f",
    "tuning-only LPP": ".2f",
    "RoPE LPP": ".2f",
    "seconds": ".1f",
}
OPTIONS = {
    "--n-calibration": {"type": int, "nargs": "+", "default": [10, 50, 200]},
    "--seeds": {"type": int, "nargs": "+", "default": [0, 1, 2]},
    "--settings": {"nargs": "+", "default": [*SETTINGS], "choices": SETTINGS},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield the means over seeds of each setting."""
    task = get_task(args.task, root=args.root)
    cache = cache_of(args.out)
    npe = trained_npe(task, seed=0, cache=cache)
    for n, setting in itertools.product(args.n_calibration, args.settings):
        content = {
            "task": task.name,
            "setting": setting,
            "options": SETTINGS[setting],
            "pairs": n,
        }
        runs = [
            cache.get(
                "finetuning",
                {**content, "seed": seed},
                partial(run, task, npe, setting, n, seed),
            )
            for seed in args.seeds
        ]
        means = pd.DataFrame(runs).mean()
        numbers = {name: f"{means[name]:{form}}" for name, form in FORMATS.items()}
        yield {"pairs": n, "setting": setting, **numbers, "seeds": len(runs)}


def run(task: Task, npe: Any, setting: str, n: int, seed: int) -> dict[str, float]:
    """Tune on the first n pairs of a seed and score on the last 500."""
    (theta, x), (theta_v, x_v) = labelled(task, seed=seed)
    start = time.perf_counter()
    source: dict[str, Any] = {"simulator": task.get_simulator()}
    if setting.startswith("stored"):
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            stored = task.get_prior().sample((10_000,))
            source = {"simulations": (stored, task.get_simulator()(stored))}
    rope = RoPE(
        npe,
        finetuner=CalibrationFinetuner(**SETTINGS[setting]),
        coupler=SinkhornCoupler(gamma=0.1, cost_scale="simulated"),
        **source,
    )
    rope.append_calibration(theta[:n], x[:n]).train(seed=seed, show_progress_bars=False)
    seconds = time.perf_counter() - start
    posterior = rope.build_posterior(x_v, seed=seed)
    natural = posterior.log_prob_batched(theta_v, x_v, norm_posterior=False)
    tuned = lpp(rope.tuned_posterior(), theta_v, x_v, theta_std=task.prior_std)
    return {
        "best step": rope.history.best_epoch,
        "distance": distance_to_targets(task, rope, theta_v, x_v),
        "tuning-only LPP": tuned.mean,
        "RoPE LPP": float(natural.mean() + task.prior_std.log().sum()),
        "seconds": seconds,
    }


def distance_to_targets(task: Task, rope: RoPE, theta: Tensor, x: Tensor) -> float:
    """Mean distance of g(x_o) from the mean embedding of 100 simulations."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        x_s = task.get_simulator()(theta.repeat_interleave(100, dim=0))
        h, g = rope.embedding_net, rope.tuned_embedding_net
        targets = torch.cat([h(part) for part in x_s.split(1000)])
        targets = targets.reshape(len(theta), 100, -1).mean(dim=1)
        return float((g(x) - targets).norm(dim=1).mean())


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS, choices=[*NPE_SETTINGS]))))
