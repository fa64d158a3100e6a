"""The baselines, each made small enough to be trained in a fraction of a second.

A method that is added to ``METHODS`` is held to ``tests/contract/test_baseline.py``.
"""

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

import sbi_rope.baselines as methods
from sbi_rope import CalibrationFinetuner
from sbi_rope.methods import DiscrepancyNPE, FinetunedNPE, Method, Training
from sbi_rope.methods.base import Kind
from sbi_rope.tasks import Task, get_task
from sbi_rope.utils.seeds import seeded

# The task with a bounded prior.
BOUNDED = "pendulum"
SHORT = Training(training_batch_size=50, learning_rate=3e-3, max_num_epochs=3)
NPE: dict[str, Any] = {"npe_training": SHORT}
BRIEF: dict[str, Any] = {**NPE, "training": SHORT}
ERRORS: dict[str, Any] = {**BRIEF, "surrogate_training": SHORT}
CORRECTION: dict[str, Any] = {**NPE, "num_steps": 5}
CHAINS = {"num_denoised": 8, "num_chains": 2, "warmup": 2, "thin": 1}
FINETUNER = CalibrationFinetuner(learning_rate=3e-3, max_num_epochs=5)


@dataclass(frozen=True)
class Entry:
    """How a method is made small: its class, its options, the task it is tried on.

    There is no simulator among the options, so that a method learns the same from a
    posterior that was trained beforehand.
    """

    kind: type[Method]
    options: dict[str, Any] = field(default_factory=dict)
    task: str = "linear_gaussian"


def swing(theta: Tensor) -> Tensor:
    """The pendulum without noise, phase and friction, differentiable in theta."""
    none = 0.0 * theta[:, :1]
    simulator: Any = task_of("pendulum").get_simulator()
    return simulator.position(theta, phase=none, damping=none)


METHODS: dict[str, Entry] = {
    "prior": Entry(methods.PriorBaseline),
    "npe": Entry(methods.PlainNPE, NPE),
    "sbi": Entry(methods.ReferenceNPE, NPE),
    "tuning_only": Entry(methods.TuningOnly, {**NPE, "finetuner": FINETUNER}),
    "ot_only": Entry(methods.OTOnly, {**NPE, "num_simulations": 60}),
    "joint_npe": Entry(methods.JointNPE, {"training": SHORT}),
    "calibration_mlp": Entry(methods.CalibrationMLP, {"training": SHORT}),
    "regression": Entry(methods.Regression),
    "finetuned_npe": Entry(FinetunedNPE, BRIEF),
    "finetuned_npe_averaged": Entry(FinetunedNPE, BRIEF | {"num_holdouts": 3}),
    "discrepancy_embedding": Entry(DiscrepancyNPE, CORRECTION),
    "discrepancy_input": Entry(DiscrepancyNPE, CORRECTION | {"space": "input"}),
    "fmcpe": Entry(methods.FMCPE, BRIEF),
    "frisbi": Entry(methods.FRISBI, BRIEF),
    "frisbi_distilled": Entry(methods.FRISBI, BRIEF | {"distilled": True}),
    "npe_rs": Entry(methods.NPERS, {"training": SHORT}),
    "nnpe": Entry(methods.NNPE, BRIEF),
    "hvae": Entry(methods.HVAE, {**BRIEF, "physics": swing, "width": 2}, "pendulum"),
    "rvnp": Entry(methods.RVNP, ERRORS),
    "rvnp_offset": Entry(methods.RVNP, ERRORS | {"shift": True}),
    "rnpe": Entry(methods.RNPE, BRIEF | CHAINS),
}


@dataclass(frozen=True, eq=False)
class Data:
    """All that a method may see, and the parameters of the observations it may not."""

    theta: Tensor
    x: Tensor
    theta_cal: Tensor
    x_cal: Tensor
    theta_o: Tensor
    x_o: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> "Data":
        return Data(**{name: function(value) for name, value in vars(self).items()})


task_of: Callable[[str], Task] = functools.cache(get_task)


@functools.cache
def data_of(task: str) -> Data:
    source = task_of(task)
    return Data(
        *source.get_simulations(100),
        *source.get_calibration_set(20),
        *source.get_test_set(30),
    )


def builder(task: str, net: nn.Module | None = None) -> Any:
    """A small density estimator of sbi, with a small embedding net unless given one."""
    options: dict[str, Any] = {"model": "maf", "num_transforms": 1}
    if task == "linear_gaussian":
        options = {"model": "mdn", "num_components": 2}
    net = net_of(task) if net is None else net
    return posterior_nn(embedding_net=net, hidden_features=10, **options)


def net_of(task: str) -> nn.Module:
    """The net for the observations of a task, always with the same weights."""
    with seeded(0):
        first = nn.Linear(math.prod(task_of(task).x_shape), 8)
        return nn.Sequential(nn.Flatten(), first, nn.ReLU(), nn.Linear(8, 4))


def make(name: str, task: str | None = None, *, net: nn.Module | None = None) -> Method:
    """A method that has seen nothing yet, for its own task unless given one."""
    entry = METHODS[name]
    task = task or entry.task
    return entry.kind(task_of(task).get_prior(), builder(task, net), **entry.options)


def names_that_see(kind: Kind) -> list[str]:
    return [name for name, entry in METHODS.items() if kind in entry.kind.sees]


def feed(method: Method, data: Data, *, without: Kind | None = None) -> Method:
    """Append all that a method may see, leaving out one kind of data."""
    for kind in sorted(method.sees - {without}, reverse=True):
        if kind != "simulations" or method.needs_simulations:
            append(method, kind, data)
    return method


def append(method: Method, kind: Kind, data: Data) -> Method:
    """Append one kind of data."""
    if kind == "simulations":
        return method.append_simulations(data.theta, data.x)
    if kind == "calibration":
        return method.append_calibration(data.theta_cal, data.x_cal)
    return method.append_observations(data.x_o)


def train(method: Method, *, seed: int | None = 0) -> Method:
    """Train without a word; what is said of short trainings is not of interest."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Maximum number of epochs")
        return method.train(seed=seed, show_progress_bars=False)


@functools.cache
def trained(name: str, task: str | None = None) -> Method:
    """A method trained on all it may see with seed 0, for reading only."""
    return train(feed(make(name, task), data_of(task or METHODS[name].task)))


def result(name: str, task: str | None = None) -> Any:
    """The posterior of the cached training."""
    return trained(name, task).build_posterior()


def densities(posterior: Any, task: str) -> Tensor:
    """Log densities that two equal posteriors share and two others do not."""
    data = data_of(task)
    return log_prob(posterior, data.theta[:5, None].repeat(1, 4, 1), data.x_o[:4])


@functools.cache
def expected_densities(name: str, task: str | None = None) -> Tensor:
    """Those of the cached training."""
    return densities(result(name, task), task or METHODS[name].task)


def log_prob(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Log densities at observations, not divided by the mass inside the prior."""
    return posterior.log_prob_batched(theta, x=x, norm_posterior=False)


def sample(posterior: Any, n: int, x: Tensor) -> Tensor:
    """Draws at observations, those outside the prior included, ``(n, B, d)``."""
    options = {"reject_outside_prior": False, "show_progress_bars": False}
    return posterior.sample_batched((n,), x=x, **options)
