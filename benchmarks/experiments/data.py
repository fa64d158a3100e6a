"""The data of experiments on a task: calibration rows only, never the test set."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor

from benchmarks.cases import Case, Pairs, Sources, posterior_with, state_of
from benchmarks.cells import Cell
from benchmarks.scoring import rope_of
from benchmarks.store import Cache
from sbi_rope import RoPE
from sbi_rope.errors import warn_user
from sbi_rope.mixture import MixtureEstimator, Part
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import NUM_FOLDS, Workbench
from sbi_rope.tasks import Task

__all__ = [
    "NPE_SETTINGS",
    "average_lpp",
    "cache_of",
    "calibration_data",
    "case_of",
    "labelled",
    "some_folds",
    "trained_npe",
]

# Labelled calibration rows: the first ones are tuned on, the last ones scored on.
NUM_LABELLED, NUM_SCORED = 1000, 500
# Calibration rows that a stack is scored on.
NUM_OTHERS = 300
# A few tell the shapes of an estimator; its scales are among its weights.
NUM_FOR_SHAPES = 10
# Simulations, options of the estimator, options of the training.
NPE_SETTINGS: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
    "light_tunnel_sensors": (
        20_000,
        {"num_transforms": 3},
        {"training_batch_size": 200, "learning_rate": 1e-3, "max_num_epochs": 40},
    ),
    "pendulum": (
        10_000,
        {"num_transforms": 2, "z_score_x": "structured"},
        {"training_batch_size": 100, "learning_rate": 1e-3, "max_num_epochs": 12},
    ),
}


def cache_of(folder: Path) -> Cache:
    """Return what experiments keep in a folder, so that they can be resumed."""
    for old in sorted([*folder.glob("*.csv"), *folder.glob("*.npz")]):
        warn_user(
            f"{old} is a result of an older version and is not read: what it holds is "
            "computed anew. Remove the file if you do not need it."
        )
    return Cache(folder)


def case_of(args: argparse.Namespace, task: str | None = None, **fields: Any) -> Case:
    """Return the case of a cell with the options of the command line."""
    cell = Cell(
        task=task or args.task,
        variant=args.variant,
        preset=args.preset,
        **{"method": "RoPE", **fields},
    )
    sources = Sources(root=args.root, hemodynamics=args.hemodynamics)
    return Case.of(cell, sources, cache_of(args.out), "cpu")


def labelled(task: Task, *, seed: int) -> tuple[Pairs, Pairs]:
    """Return calibration rows of a seed: to tune on, and to score on."""
    theta, x = task.get_calibration_set(NUM_LABELLED, seed=seed)
    first, last = slice(None, -NUM_SCORED), slice(-NUM_SCORED, None)
    return (theta[first], x[first]), (theta[last], x[last])


def calibration_data(
    case: Case, n_calibration: int, *, seed: int
) -> tuple[RoPE, Pairs]:
    """Return a RoPE with pairs of the calibration set, and others of it."""
    count = n_calibration + NUM_OTHERS
    recorded = case.task.num_recorded("calibration", seed=seed)
    if recorded is not None:
        count = min(count, recorded)
    theta, x = case.task.get_calibration_set(count, seed=seed)
    rope = rope_of(case)
    rope.append_calibration(theta[:n_calibration], x[:n_calibration])
    return rope, (theta[n_calibration:], x[n_calibration:])


def some_folds(rope: RoPE, count: int, *, seed: int) -> list[Fold]:
    """Return the pairs without each of the first folds of a stack."""
    bench = Workbench(rope, num_folds=NUM_FOLDS, seed=seed, show_progress_bars=False)
    numbers = range(len(bench.folds))
    return [
        Fold(bench, [number for number in numbers if number != left_out])
        for left_out in numbers[:count]
    ]


def average_lpp(parts: Sequence[Part], pairs: Pairs, task: Task) -> float:
    """Return the LPP of an average, in standard deviations of the prior."""
    estimator = MixtureEstimator(parts, [1.0 / len(parts)] * len(parts))
    of_each = estimator.part_log_probs(*pairs) + estimator.weights.log()
    log_prob = of_each.logsumexp(dim=1).mean()
    return float(log_prob + task.prior_std.log().sum())


def trained_npe(task: Task, *, seed: int, cache: Cache) -> Any:
    """Return the posterior of NPE with the task's full embedding net."""
    num_simulations, estimator, training = NPE_SETTINGS[task.name]
    prior = task.get_prior()

    def builder() -> Any:
        net = task.get_embedding_net()
        return posterior_nn("nsf", embedding_net=net, **estimator)

    def train() -> Any:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            theta = prior.sample((num_simulations,))
            npe = NPE(prior, density_estimator=builder())
            npe.append_simulations(theta, task.get_simulator()(theta))
            npe.train(**training)
        return npe.build_posterior()

    def unpack(state: dict[str, Tensor]) -> Any:
        with torch.random.fork_rng():
            theta = prior.sample((NUM_FOR_SHAPES,))
            pairs = theta, task.get_simulator()(theta)
            return posterior_with(
                state, prior=prior, build=builder(), simulations=pairs
            )

    content = {
        "task": task.name,
        "variant": task.variant,
        "seed": seed,
        "simulations": num_simulations,
        "estimator": estimator,
        "training": training,
    }
    return cache.get("npe", content, train, pack=state_of, unpack=unpack)
