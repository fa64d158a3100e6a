"""NPE on the simulations of a task, trained once and kept in a file."""

from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor

from benchmarks.estimators import posterior_with, state_of
from benchmarks.store import Cache
from sbi_rope.errors import warn_user
from sbi_rope.tasks import Task

__all__ = ["trained_npe"]

# A few tell the shapes of an estimator; its scales are among its weights.
NUM_FOR_SHAPES = 10
# Simulations, options of the estimator, options of the training.
SETTINGS: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
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


def trained_npe(task: Task, *, seed: int, cache: Path) -> Any:
    """Return the posterior of a seed, from the cache folder if it is there."""
    old = cache / f"npe_{task.name}_{seed}.pt"
    if old.exists():
        warn_user(
            f"{old} is a cache of an older version, and is not opened, because that "
            "could run code. NPE is trained anew; remove the file if you like."
        )
    num_simulations, estimator, training = SETTINGS[task.name]
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
    return Cache(cache).get("npe", content, train, pack=state_of, unpack=unpack)
