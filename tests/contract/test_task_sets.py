"""The labelled sets of every task: reproducible, disjoint, of the law they should have.

All sets are made by the same code, which ``tests/unit/test_tasks_base.py`` tests. The
contract is checked for the standard process of every task, for the one that is the
simulator, and for the variants that run code of a task's own. One task with a process
to draw from and one with recordings stand for the others in the variants that all tasks
have.
"""

import random
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS
from tests.tasks import (
    MEASURED,
    SUBTLE,
    as_many,
    draw,
    largest_z,
    make,
    rows_of,
    same_rows,
)

# Variants whose calibration set follows another law than the test set.
ANOTHER_CALIBRATION_LAW = {"biased_calibration", "sensor_settings", "flipped"}
# One process that is drawn, one that is recorded, and one with bias of its own.
FOR_THE_REST = {"pendulum", "light_tunnel_sensors", "light_tunnel"}
PARTS = ("calibration", "test")
# Two blocks of a drawn set or more. 400 observations tell a process that differs from
# the simulator by 13 standard errors or more.
SIZES = {("calibration", 0): 250, ("test", 0): 400} | {(part, 1): 130 for part in PARTS}
KINDS = [
    (name, variant)
    for name, task in TASKS.items()
    for variant in (None, *task.variants)
    if variant == "well_specified"
    or variant not in COMMON_VARIANTS
    or name in FOR_THE_REST
]
EVERY_TASK = pytest.mark.parametrize("name", sorted(TASKS))


@dataclass(frozen=True)
class Drawn:
    """A task and two sets of each part, for all tests to read."""

    task: Task
    sets: dict[tuple[str, int], tuple[Tensor, Tensor]]


@pytest.fixture(scope="module", params=KINDS, ids=str)
def drawn(request: pytest.FixtureRequest) -> Drawn:
    name, variant = request.param
    task = make(name, variant=variant)
    sets = {
        (part, seed): draw(task, part, as_many(n, task, part, seed=seed), seed=seed)
        for (part, seed), n in SIZES.items()
    }
    return Drawn(task, sets)


def state_of_all_generators() -> list[bytes]:
    return [
        torch.get_rng_state().numpy().tobytes(),
        repr(random.getstate()).encode(),
        repr(np.random.get_state()).encode(),  # noqa: NPY002
    ]


@pytest.mark.medium
def test_sets_have_the_shapes_asked_for_and_no_observation_in_common(
    drawn: Drawn,
) -> None:
    task = drawn.task
    prior = task.get_prior()
    for (part, seed), (theta, x) in drawn.sets.items():
        n = as_many(SIZES[part, seed], task, part, seed=seed)
        assert theta.shape == (n, task.theta_dim)
        assert x.shape == (n, *task.x_shape)
        assert theta.dtype == x.dtype == torch.float32
        assert torch.isfinite(x).all()
        assert within_support(prior, theta).all()
        assert len(set(rows_of(x))) == len(x)
        # A caller's draws under the same seed share nothing with the set either.
        torch.manual_seed(seed)
        assert same_rows(prior.sample(torch.Size((1000,))), theta) == 0
    for one, other in ((0, 0), (0, 1), (1, 0)):
        calibration, test = (
            drawn.sets[p, s] for p, s in zip(PARTS, (one, other), strict=True)
        )
        assert same_rows(calibration[1], test[1]) == 0
        assert same_rows(calibration[0], test[0]) <= 0.01 * len(test[0])


@pytest.mark.medium
def test_a_set_depends_on_nothing_but_its_seed_and_leaves_no_trace(
    drawn: Drawn,
) -> None:
    for part in PARTS:
        expected, other = (drawn.sets[part, seed] for seed in (0, 1))
        for a, b in zip(expected, other, strict=True):
            assert not torch.equal(a[:20], b[:20])
        before = state_of_all_generators()
        # Integers of NumPy would overflow in the numbers of random streams.
        again = draw(drawn.task, part, np.int64(7), seed=np.uint8(1))
        assert state_of_all_generators() == before
        torch.set_default_dtype(torch.float64)
        try:
            with torch.device("meta"):
                elsewhere = draw(drawn.task, part, 7)
        finally:
            torch.set_default_dtype(torch.float32)
        for found, whole in ((again, other), (elsewhere, expected)):
            assert all(torch.equal(a, b[:7]) for a, b in zip(found, whole, strict=True))


@pytest.mark.medium
def test_calibration_and_test_sets_follow_one_law_unless_the_variant_says_otherwise(
    drawn: Drawn,
) -> None:
    calibration, test = (drawn.sets[part, 0] for part in PARTS)
    same = [largest_z(a, b) < 4.5 for a, b in zip(calibration, test, strict=True)]
    if drawn.task.variant not in ANOTHER_CALIBRATION_LAW:
        # Noise on the labels of the calibration set leaves the observations alone.
        assert same[1]
        assert same[0] or drawn.task.variant == "noisy_labels"
    elif len(calibration[0]) >= 100:
        assert not all(same)


@pytest.mark.medium
def test_real_observations_follow_the_simulator_only_where_the_variant_says_so(
    drawn: Drawn,
) -> None:
    theta, x_o = drawn.sets["test", 0]
    x_s = drawn.task.get_simulator()(theta)
    if drawn.task.variant == "well_specified":
        assert drawn.task.required_files == ()
        assert largest_z(x_s, x_o, paired=True) < 4.5
    elif drawn.task.name not in SUBTLE:
        assert largest_z(x_s, x_o, paired=True) > 6.0


# The variants that every task has ----------------------------------------------------


@EVERY_TASK
def test_shifted_parameters_stay_in_the_region(name: str) -> None:
    task = make(name, variant="prior_shift")
    for part in PARTS:
        theta, _ = draw(task, part, as_many(100, task, part) // 3)
        for parameter, (low, high) in task.shifted_region.items():
            values = theta[:, task.parameter_names.index(parameter)]
            assert ((values >= low) & (values <= high)).all()


@pytest.mark.medium
@EVERY_TASK
def test_biased_calibration_parameters_crowd_in_the_middle(name: str) -> None:
    task = make(name, variant="biased_calibration")
    spread, margin = [], []
    for part in PARTS:
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
    spread = {}
    for noise in (None, 0.001):
        noisy = make(name, variant="noisy_labels", label_noise=noise)
        noisy_theta, same_x = noisy.get_calibration_set(n)
        assert torch.equal(x, same_x)
        spread[noise] = ((noisy_theta - theta) / clean.prior_std).std(dim=0)
    sets = (task.get_test_set(40) for task in (clean, noisy))
    assert all(torch.equal(a, b) for a, b in zip(*sets, strict=True))
    # The default is 0.2, and less where the support of the prior cuts the noise.
    assert spread[None].max() < 0.2 * (1 + 2.2 / n**0.5)
    assert spread[None].min() > 0.2 * (0.85 - 2.2 / n**0.5)
    expected = torch.full_like(spread[0.001], 0.001)
    torch.testing.assert_close(spread[0.001], expected, rtol=2.8 / n**0.5, atol=0)
