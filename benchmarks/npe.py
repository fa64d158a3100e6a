"""NPE on the simulations of a task, trained once and kept in a file."""

from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn

from sbi_rope.tasks import Task

__all__ = ["trained_npe"]

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
    path = cache / f"npe_{task.name}_{seed}.pt"
    if path.exists():
        return torch.load(path, weights_only=False)
    num_simulations, estimator, training = SETTINGS[task.name]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        prior = task.get_prior()
        theta = prior.sample((num_simulations,))
        npe = NPE(
            prior,
            density_estimator=posterior_nn(
                "nsf", embedding_net=task.get_embedding_net(), **estimator
            ),
        )
        npe.append_simulations(theta, task.get_simulator()(theta)).train(**training)
    posterior = npe.build_posterior()
    torch.save(posterior, path)
    return posterior
