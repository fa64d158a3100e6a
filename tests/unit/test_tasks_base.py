"""The registry and what the base class of tasks does."""

from pathlib import Path

import numpy as np
import pytest
import torch
from sbi.utils import within_support

from sbi_rope.errors import InvalidInputError
from sbi_rope.tasks import TASKS, Task, get_task, list_tasks
from sbi_rope.tasks.cs import CancerStromaSimulator
from sbi_rope.tasks.distributions import Arcsine, UniformDistance
from sbi_rope.tasks.hemodynamics.dataset import load
from sbi_rope.tasks.hemodynamics.generation import generate
from sbi_rope.tasks.hemodynamics.subject import Physics
from sbi_rope.tasks.light_tunnel_models import CameraSimulator, HexagonSimulator
from sbi_rope.tasks.light_tunnel_network import ImageEmbedding
from sbi_rope.tasks.linear_gaussian import LinearGaussianSimulator
from sbi_rope.tasks.networks import SeriesEmbedding, fully_connected
from sbi_rope.tasks.sir import SIRSimulator
from sbi_rope.tasks.triangle import UniformTriangle
from sbi_rope.tasks.variants import beta_shaped, with_label_noise
from sbi_rope.tasks.wind_tunnel_model import WindTunnelSimulator
from tests.tasks import accepted


def test_tasks_are_registered_and_listed_under_their_names() -> None:
    assert {name: task.name for name, task in TASKS.items()} == {n: n for n in TASKS}
    assert list_tasks() == sorted(TASKS)


def test_get_task_passes_all_options_on_to_the_task() -> None:
    task = get_task(
        "pendulum",
        variant="misspecified_prior",
        root="~/data",
        misspecification_weight=0.25,
    )
    assert task.name == "pendulum"
    assert task.variant == "misspecified_prior"
    assert task.root == Path("~/data").expanduser()
    assert task.misspecification_weight == 0.25  # type: ignore[attr-defined]


def test_names_that_do_not_exist_are_answered_with_those_that_do() -> None:
    for call, match in (
        (lambda: get_task("pendulu"), r"'light_tunnel_sensors'.*'pendulum'"),
        (
            lambda: get_task("pendulum", variant="damped"),
            r"`variant`.*'misspecified_prior'.*'damped'",
        ),
        (
            lambda: get_task("pendulum", noise=1.0),
            r"options of 'pendulum'.*'noise_std'.*\['noise'\]",
        ),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()


LIST = np.array(["a", "b"])
OPTIONS = {
    "cs": {"necrosis_probability": "0.5", "root": 3},
    "hemodynamics": {"simulations": 3, "observations": b"x", "prior": LIST},
    "light_tunnel": {
        "dequantise": "x",
        "stand_in": 1,
        "image_size": 64.0,
        "experiment": ["a"],
        "download": "no",
    },
    "light_tunnel_sensors": {"experiment": 3, "current_noise_std": 1e39},
    "linear_gaussian": {"scale": 10**400, "shift": "1", "noise_std": 1e39, "dim": 2.0},
    "pendulum": {"variant": LIST, "max_damping": LIST, "noise_std": True},
    "sir": {"reported_fraction": LIST, "variant": ["x"], "root": ["a"]},
    "wind_tunnel": {"onset_jitter": LIST, "experiment": LIST, "stand_in": "yes"},
}


def test_options_of_another_kind_are_refused_by_name() -> None:
    cases = {
        f"{name}({option}={value!r})": (
            lambda name=name, option=option, value=value: get_task(
                name, **{option: value}
            ),
            f"`{option}`",
        )
        for name, options in OPTIONS.items()
        for option, value in options.items()
    }
    assert not accepted(cases)


BAD_PARTS = [
    (lambda: CancerStromaSimulator(batched="x"), "batched"),  # type: ignore[arg-type]
    (lambda: SIRSimulator(time_step=1e-300), "time_step"),
    (lambda: SIRSimulator(volatility=-1.0), "volatility"),
    (lambda: HexagonSimulator(dequantise="x"), "dequantise"),  # type: ignore[arg-type]
    (lambda: HexagonSimulator(image_size=10**9), "image_size"),
    (lambda: CameraSimulator(dequantise=1), "dequantise"),  # type: ignore[arg-type]
    (lambda: LinearGaussianSimulator(scale=0.0), "scale"),
    (lambda: WindTunnelSimulator(onset_jitter=1e6), "onset_jitter"),
    (lambda: WindTunnelSimulator(exhaust_offset=float("nan")), "exhaust_offset"),
    (lambda: Arcsine(1.0), "width"),  # type: ignore[arg-type]
    (lambda: UniformDistance(torch.tensor([-1.0])), "width"),
    (lambda: UniformTriangle(torch.tensor(float("nan"))), "high"),
    (lambda: fully_connected(3, ()), "widths"),
    (lambda: fully_connected(3, "ab"), "widths"),  # type: ignore[arg-type]
    (lambda: fully_connected(0, (3,)), "input_dim"),
    (lambda: SeriesEmbedding(pools=((3, 1),)), "pools"),
    (lambda: SeriesEmbedding(pools=3), "pools"),  # type: ignore[arg-type]
    (lambda: ImageEmbedding(light="x"), "light"),  # type: ignore[arg-type]
    (lambda: Physics(viscoelastic="x"), "viscoelastic"),  # type: ignore[arg-type]
    (lambda: generate(3, n=1, process="real"), "path"),  # type: ignore[arg-type]
    (lambda: load(None), "path"),  # type: ignore[arg-type]
]


def test_the_parts_of_a_task_refuse_bad_arguments_by_name() -> None:
    assert not accepted({f"{i}: {bad[1]}": bad for i, bad in enumerate(BAD_PARTS)})


def test_repr_names_the_variant() -> None:
    assert repr(get_task("pendulum")) == "Pendulum()"
    task = get_task("pendulum", variant="misspecified_prior")
    assert repr(task) == "Pendulum(variant='misspecified_prior')"


def test_a_task_must_have_a_prior_its_quantiles_and_a_real_process() -> None:
    required = {"get_prior", "prior_quantiles", "_real_process"}
    assert required <= Task.__abstractmethods__


def test_an_option_without_effect_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`max_damping` has no effect"):
        get_task("pendulum", variant="well_specified", max_damping=0.5)


def test_the_beta_shape_is_a_density_over_its_maximum() -> None:
    u = torch.rand(1000, 2, dtype=torch.float64)
    law = torch.distributions.Beta(
        torch.tensor(3.0, dtype=torch.float64), torch.tensor(3.0, dtype=torch.float64)
    )
    highest = law.log_prob(torch.tensor(0.5, dtype=torch.float64))
    expected = (law.log_prob(u) - highest).sum(dim=1).exp()
    torch.testing.assert_close(beta_shaped(u), expected)


def test_the_beta_shape_looks_at_the_first_three_parameters_only() -> None:
    u = torch.rand(10, 25)
    assert torch.equal(beta_shaped(u), beta_shaped(u[:, :3]))


def test_label_noise_stays_in_the_support_and_does_not_depend_on_later_rows() -> None:
    prior = get_task("pendulum").get_prior()
    theta = prior.sample(torch.Size((250,)))
    std = torch.tensor([1.0, 3.0])
    noisy = with_label_noise(theta, std, prior, seed=3)
    assert within_support(prior, noisy).all()
    assert torch.equal(with_label_noise(theta[:130], std, prior, seed=3), noisy[:130])
    assert not torch.equal(with_label_noise(theta, std, prior, seed=4), noisy)


def test_label_noise_is_gaussian_where_the_support_is_wide() -> None:
    prior = get_task("linear_gaussian").get_prior()
    theta = prior.sample(torch.Size((4000,)))
    std = torch.tensor([0.5, 2.0])
    noise = (with_label_noise(theta, std, prior, seed=0) - theta) / std
    levels = torch.distributions.Normal(0.0, 1.0).cdf(noise).sort(dim=0).values
    steps = torch.arange(1, 4001).unsqueeze(1) / 4000
    assert (levels - steps).abs().max() < 2.2 / 4000**0.5
