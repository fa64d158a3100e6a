"""The variants that every task has."""

import pytest
import torch

from sbi_rope.tasks import TASKS
from tests.tasks import MEASURED, as_many, draw, make

EVERY_TASK = pytest.mark.parametrize("name", sorted(TASKS))


@EVERY_TASK
def test_shifted_parameters_stay_in_the_region(name: str) -> None:
    task = make(name, variant="prior_shift")
    for part in ("calibration", "test"):
        theta, _ = draw(task, part, as_many(100, task, part) // 3)
        for parameter, (low, high) in task.shifted_region.items():
            values = theta[:, task.parameter_names.index(parameter)]
            assert (values >= low).all()
            assert (values <= high).all()


@pytest.mark.medium
@EVERY_TASK
def test_biased_calibration_parameters_crowd_in_the_middle(name: str) -> None:
    task = make(name, variant="biased_calibration")
    spread, margin = [], []
    for part in ("calibration", "test"):
        n = as_many(200, task, part)
        theta, _ = draw(task, part, n)
        spread.append(task.prior_quantiles(theta)[:, :3].std(dim=0))
        margin.append(0.5 / n**0.5)
    # Standard deviations of Beta(3, 3) and of the uniform law, and a margin of three
    # standard errors or more. Parameters of the sea or of meat never follow a prior.
    assert (spread[0] < 0.189 + margin[0]).all()
    if name not in MEASURED:
        assert (spread[1] > 0.289 - margin[1]).all()


@pytest.mark.medium
@EVERY_TASK
def test_noisy_labels_belong_to_the_observations_of_the_standard_task(
    name: str,
) -> None:
    clean = make(name)
    n = as_many(200, clean, "calibration")
    theta, x = clean.get_calibration_set(n)
    scaled = {}
    for noise in (None, 0.001, 0.002):
        noisy = make(name, variant="noisy_labels", label_noise=noise)
        noisy_theta, same_x = noisy.get_calibration_set(n)
        assert torch.equal(x, same_x)
        scaled[noise] = (noisy_theta - theta) / clean.prior_std
        assert (scaled[noise] != 0).all()
    sets = (task.get_test_set(40) for task in (clean, noisy))
    assert all(torch.equal(a, b) for a, b in zip(*sets, strict=True))
    # The default is 0.2, and less where the support of the prior cuts the noise.
    assert scaled[None].std(dim=0).max() < 0.2 * (1 + 2.2 / n**0.5)
    assert scaled[None].std(dim=0).min() > 0.2 * (0.85 - 2.2 / n**0.5)
    small, large = (scaled[noise].std(dim=0) for noise in (0.001, 0.002))
    expected = torch.full_like(small, 0.001)
    torch.testing.assert_close(small, expected, rtol=2.8 / n**0.5, atol=0)
    torch.testing.assert_close(large, 2 * small, rtol=0.1, atol=0)


def test_well_specified_data_need_no_files() -> None:
    for name in TASKS:
        task = TASKS[name](variant="well_specified")
        assert task.required_files == ()
        assert torch.isfinite(task.get_test_set(5)[1]).all()
