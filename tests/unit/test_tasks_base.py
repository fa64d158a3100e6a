"""The registry and what the base class of tasks does."""

import pytest
import torch
from sbi.utils import within_support

from sbi_rope.tasks import TASKS, get_task, list_tasks
from sbi_rope.tasks.variants import beta_shaped, with_label_noise
from sbi_rope.utils.errors import InvalidInputError


def test_tasks_are_registered_and_listed_under_their_names() -> None:
    assert {name: task.name for name, task in TASKS.items()} == {n: n for n in TASKS}
    assert list_tasks() == sorted(TASKS)


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


def test_label_noise_stays_in_the_support_and_does_not_depend_on_later_rows() -> None:
    prior = get_task("pendulum").get_prior()
    theta = prior.sample(torch.Size((250,)))
    std = torch.tensor([1.0, 3.0])
    noisy = with_label_noise(theta, std, prior, seed=3)
    assert within_support(prior, noisy).all()
    assert torch.equal(with_label_noise(theta[:130], std, prior, seed=3), noisy[:130])
    assert not torch.equal(with_label_noise(theta, std, prior, seed=4), noisy)
