"""The baselines, each made small enough to be trained in a fraction of a second.

A method that is added to ``METHODS`` is held to ``tests/contract/test_baseline.py``.
"""

import functools
import inspect
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sbi.inference import DirectPosterior
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, MixturePosterior
from sbi_rope.baselines import (
    FMCPE,
    FRISBI,
    HVAE,
    NNPE,
    NPERS,
    RNPE,
    RVNP,
    CalibrationMLP,
    FinetunedNPE,
    JointNPE,
    Method,
    OTOnly,
    PlainNPE,
    PriorBaseline,
    ReferenceNPE,
    Regression,
    Training,
    TuningOnly,
)
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.methods.base import Kind
from sbi_rope.tasks import Task, get_task
from sbi_rope.utils.seeds import seeded
from tests.conftest import SHARED_DATA

VECTOR_TASKS = ("linear_gaussian", "light_tunnel_sensors")
SHORT = Training(training_batch_size=50, learning_rate=3e-3, max_num_epochs=3)
CHAINS: dict[str, Any] = {
    "training": SHORT,
    "num_denoised": 8,
    "num_chains": 2,
    "warmup": 2,
    "thin": 1,
}
FINETUNER = CalibrationFinetuner(learning_rate=3e-3, max_num_epochs=5)

# Without a simulator: then they learn the same from a posterior trained beforehand.
BRIEF: dict[str, Any] = {"npe_training": SHORT, "training": SHORT}
ERRORS: dict[str, Any] = {**BRIEF, "surrogate_training": SHORT}
CORRECTION: dict[str, Any] = {"npe_training": SHORT, "num_steps": 5}


@dataclass(frozen=True)
class Entry:
    """How a method is made small: its class, its options, the tasks it is tried on."""

    kind: type[Method]
    options: Callable[[Task], dict[str, Any]] = lambda task: {}
    tasks: tuple[str, ...] = VECTOR_TASKS


def swing(theta: Tensor) -> Tensor:
    """The pendulum without noise, phase and friction, differentiable in theta."""
    none = 0.0 * theta[:, :1]
    simulator: Any = task_of("pendulum").get_simulator()
    return simulator.position(theta, phase=none, damping=none)


METHODS: dict[str, Entry] = {
    "prior": Entry(PriorBaseline),
    "npe": Entry(PlainNPE, lambda task: {"npe_training": SHORT}),
    "sbi": Entry(ReferenceNPE, lambda task: {"npe_training": SHORT}),
    "tuning_only": Entry(
        TuningOnly, lambda task: {"npe_training": SHORT, "finetuner": FINETUNER}
    ),
    "ot_only": Entry(
        OTOnly,
        lambda task: {
            "npe_training": SHORT,
            "simulator": task.get_simulator(),
            "num_simulations": 60,
        },
    ),
    "joint_npe": Entry(JointNPE, lambda task: {"training": SHORT}),
    "calibration_mlp": Entry(CalibrationMLP, lambda task: {"training": SHORT}),
    "regression": Entry(Regression),
    "finetuned_npe": Entry(FinetunedNPE, lambda task: BRIEF),
    "finetuned_npe_averaged": Entry(
        FinetunedNPE, lambda task: {**BRIEF, "num_holdouts": 3}
    ),
    "discrepancy_embedding": Entry(DiscrepancyNPE, lambda task: CORRECTION),
    "discrepancy_input": Entry(
        DiscrepancyNPE, lambda task: {**CORRECTION, "space": "input"}
    ),
    "fmcpe": Entry(FMCPE, lambda task: BRIEF),
    "frisbi": Entry(FRISBI, lambda task: BRIEF),
    "frisbi_distilled": Entry(FRISBI, lambda task: {**BRIEF, "distilled": True}),
    "npe_rs": Entry(NPERS, lambda task: {"training": SHORT}),
    "nnpe": Entry(NNPE, lambda task: BRIEF),
    "hvae": Entry(
        HVAE, lambda task: {**BRIEF, "physics": swing, "width": 2}, ("pendulum",)
    ),
    "rvnp": Entry(RVNP, lambda task: ERRORS),
    "rvnp_offset": Entry(RVNP, lambda task: {**ERRORS, "shift": True}),
    "rnpe": Entry(RNPE, lambda task: {"npe_training": SHORT, **CHAINS}),
}
CASES = [(name, task) for name, entry in METHODS.items() for task in entry.tasks]


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


@functools.cache
def task_of(name: str) -> Task:
    root = SHARED_DATA / "causal_chamber" if "light_tunnel" in name else None
    return get_task(name, root=root)


@functools.cache
def data_of(task: str) -> Data:
    source = task_of(task)
    return Data(
        *source.get_simulations(100),
        *source.get_calibration_set(20),
        *source.get_test_set(30),
    )


def builder(
    task: str, *, net: nn.Module | None = None, family: str | None = None
) -> Any:
    """A small density estimator of sbi, with a small embedding net unless given one."""
    if net is None:
        net = net_of(task)
    if family is None:
        family = "mdn" if task == "linear_gaussian" else "maf"
    sizes: dict[str, Any] = {"mdn": {"num_components": 2}}.get(
        family, {"num_transforms": 1}
    )
    return posterior_nn(family, embedding_net=net, hidden_features=10, **sizes)


def net_of(task: str) -> nn.Module:
    """The net for the observations of a task, always with the same weights."""
    with seeded(0):
        return flat_net(math.prod(task_of(task).x_shape))


def flat_net(size: int) -> nn.Module:
    return nn.Sequential(nn.Flatten(), nn.Linear(size, 8), nn.ReLU(), nn.Linear(8, 4))


def make(
    name: str,
    task: str,
    *,
    prior: Any = None,
    density_estimator: Any = None,
    **options: Any,
) -> Method:
    """A method that has seen nothing yet."""
    entry = METHODS[name]
    prior = task_of(task).get_prior() if prior is None else prior
    options = {**entry.options(task_of(task)), **options}
    if takes_estimator(name):
        estimator = builder(task) if density_estimator is None else density_estimator
        return entry.kind(prior, estimator, **options)
    return entry.kind(prior, **options)


def takes_estimator(name: str) -> bool:
    return "density_estimator" in inspect.signature(METHODS[name].kind).parameters


def names_that_see(kind: Kind) -> list[str]:
    return [name for name, entry in METHODS.items() if kind in entry.kind.sees]


def first_task(name: str) -> str:
    return METHODS[name].tasks[0]


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
def trained(name: str, task: str) -> Method:
    """A method trained on all it may see with seed 0, for reading only."""
    return train(feed(make(name, task), data_of(task)))


def result(name: str, task: str | None = None) -> Any:
    """The posterior of the cached training."""
    return trained(name, task or first_task(name)).build_posterior()


def densities(posterior: Any, name: str, task: str | None = None) -> Tensor:
    """Log densities that two equal posteriors share and two others do not."""
    data = data_of(task or first_task(name))
    return log_prob_batched(
        posterior, data.theta[:5, None].repeat(1, 4, 1), data.x_o[:4]
    )


@functools.cache
def expected_densities(name: str, task: str | None = None) -> Tensor:
    """Those of the cached training."""
    return densities(result(name, task), name, task)


def log_prob(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Log density at one x, as the estimator states it: not divided by the leakage."""
    options = {"norm_posterior": False} if _rejects_without_bound(posterior) else {}
    return posterior.log_prob(theta, x=x, **options)


def log_prob_batched(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Log density at several x, as the estimator states it."""
    options = {"norm_posterior": False} if _rejects_without_bound(posterior) else {}
    return posterior.log_prob_batched(theta, x=x, **options)


def sample(posterior: Any, shape: tuple[int, ...], x: Tensor) -> Tensor:
    """Draws at one x, those outside the prior included."""
    return posterior.sample(shape, x=x, **_unrejected(posterior))


def sample_batched(posterior: Any, shape: tuple[int, ...], x: Tensor) -> Tensor:
    """Draws at several x, those outside the prior included."""
    return posterior.sample_batched(shape, x=x, **_unrejected(posterior))


def _unrejected(posterior: Any) -> dict[str, bool]:
    options = {"show_progress_bars": False}
    if _rejects_without_bound(posterior):
        options["reject_outside_prior"] = False
    return options


def _rejects_without_bound(posterior: Any) -> bool:
    is_ours = isinstance(posterior, MixturePosterior)
    return isinstance(posterior, DirectPosterior) and not is_ours
