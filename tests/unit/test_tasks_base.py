"""The registry and what the base class of tasks does."""

from pathlib import Path

import pytest
import torch
from sbi.utils import within_support

from sbi_rope.errors import InvalidInputError
from sbi_rope.tasks import TASKS, get_task, list_tasks
from sbi_rope.tasks.variants import beta_shaped, with_label_noise


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


def test_unknown_names_and_settings_without_effect_are_refused() -> None:
    for call, match in (
        (lambda: get_task("pendulu"), "`name`"),
        (lambda: get_task("pendulum", variant="damped"), "`variant`"),
        (lambda: get_task("pendulum", label_noise=0.1), "`label_noise`"),
        (lambda: get_task("cs", necrosis_radius=-0.1), "`necrosis_radius`"),
        (lambda: get_task("sir").get_test_set(0), "`n`"),
        (lambda: get_task("sir").get_test_set(1, seed=-1), "`seed`"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()


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
