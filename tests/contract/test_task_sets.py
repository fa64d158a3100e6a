"""The labelled sets of every task: reproducible, disjoint, of the law they should have.

All sets are made by the same code, which ``tests/unit/test_tasks_splits.py`` tests. The
contract is checked for the standard process of every task, and for the variants that
run code of a task's own. One task with a process to draw from and one with recordings
stand for the others in the variants that all tasks have.

Sets are drawn once for all tests that read them (:func:`shared`); what must be
reproduced is drawn anew and compared with them.
"""

import functools
import random
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS
from tests.tasks import (
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
# Variants that all tasks have, for which a task runs code of its own.
OWN_CODE = {("light_tunnel", "biased_calibration"), ("hemodynamics", "well_specified")}
# One process that is drawn and one that is recorded.
FOR_THE_REST = {"pendulum", "light_tunnel_sensors"}
# Tasks whose real process takes a tenth of a second for some hundred observations.
SLOW_PROCESS = {"cs", "light_tunnel", "sir"}


def runs_code_of_its_own(name: str, variant: str | None) -> bool:
    """Whether no other task's tests run what this variant of this task runs."""
    is_common = variant in COMMON_VARIANTS and name not in FOR_THE_REST
    return not is_common or (name, variant) in OWN_CODE


def kinds(*more: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        ("name", "variant"),
        [
            pytest.param(name, variant, id=f"{name}-{variant or 'standard'}")
            for name, task in TASKS.items()
            for variant in (None, *task.variants)
            if runs_code_of_its_own(name, variant) or variant in more
        ],
    )


KINDS = kinds()
PARTS = ("calibration", "test")


@pytest.fixture
def labelled(name: str, variant: str | None) -> Task:
    return make(name, variant=variant)


def size_of(task: Task, part: str, seed: int) -> int:
    """Number of observations in a shared set; two blocks of a drawn one or more."""
    if seed != 0:
        return as_many(130, task, part, seed=seed)
    if part == "calibration":
        return as_many(250, task, part)
    # Where the process differs from the simulator, 400 observations tell by 13 standard
    # errors or more. To tell that it does not takes as many as there is time for.
    few = task.name in SLOW_PROCESS and task.variant != "well_specified"
    return as_many(400 if few else 1000, task, part)


@functools.cache
def _drawn(name: str, variant: str | None, part: str, seed: int) -> tuple[Tensor, ...]:
    task = make(name, variant=variant)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return draw(task, part, size_of(task, part, seed), seed=seed)


def shared(task: Task, part: str, *, seed: int = 0) -> tuple[Tensor, ...]:
    """Return a set that all tests share; for reading only."""
    return _drawn(task.name, task.variant, part, seed)


@pytest.fixture(autouse=True, scope="module")
def _forget() -> Iterator[None]:
    """Let go of the shared sets after the last test."""
    yield
    _drawn.cache_clear()


def state_of_all_generators() -> list[bytes]:
    return [
        torch.get_rng_state().numpy().tobytes(),
        repr(random.getstate()).encode(),
        repr(np.random.get_state()).encode(),  # noqa: NPY002
    ]


@pytest.mark.medium
@KINDS
def test_sets_have_the_shapes_asked_for_and_no_observation_in_common(
    labelled: Task,
) -> None:
    prior = labelled.get_prior()
    for part in PARTS:
        theta, x = shared(labelled, part)
        n = size_of(labelled, part, 0)
        assert theta.shape == (n, labelled.theta_dim)
        assert x.shape == (n, *labelled.x_shape)
        assert theta.dtype == x.dtype == torch.float32
        assert torch.isfinite(x).all()
        assert within_support(prior, theta).all()
        assert len(set(rows_of(x))) == len(x)
    for one, other in ((0, 0), (0, 1), (1, 0)):
        calibration = shared(labelled, "calibration", seed=one)
        test = shared(labelled, "test", seed=other)
        assert same_rows(calibration[1], test[1]) == 0
        assert same_rows(calibration[0], test[0]) <= 0.01 * len(test[0])
    # Nor do the draws that a caller makes under the same seed.
    for seed in (0, 1):
        torch.manual_seed(seed)
        theta = prior.sample(torch.Size((1000,)))
        for part in PARTS:
            assert same_rows(theta, shared(labelled, part, seed=seed)[0]) == 0


@pytest.mark.medium
@KINDS
def test_a_set_depends_on_nothing_but_its_seed_and_leaves_no_trace(
    labelled: Task, capfd: pytest.CaptureFixture[str]
) -> None:
    for part in PARTS:
        expected, other = shared(labelled, part), shared(labelled, part, seed=1)
        for a, b in zip(expected, other, strict=True):
            assert not torch.equal(a[:20], b[:20])
        torch.manual_seed(2)
        before = state_of_all_generators()
        small = draw(labelled, part, 7)
        again = draw(labelled, part, np.int64(7), seed=np.uint8(1))
        assert state_of_all_generators() == before
        torch.set_default_dtype(torch.float64)
        try:
            with torch.device("meta"):
                elsewhere = draw(labelled, part, 7)
        finally:
            torch.set_default_dtype(torch.float32)
        for found, whole in ((small, expected), (again, other), (elsewhere, expected)):
            assert all(torch.equal(a, b[:7]) for a, b in zip(found, whole, strict=True))
    assert capfd.readouterr() == ("", "")


@pytest.mark.medium
@KINDS
def test_calibration_and_test_sets_follow_one_law_unless_the_variant_says_otherwise(
    labelled: Task, variant: str | None
) -> None:
    calibration, test = (shared(labelled, part) for part in PARTS)
    same = [largest_z(a, b) < 4.5 for a, b in zip(calibration, test, strict=True)]
    if variant not in ANOTHER_CALIBRATION_LAW:
        # Noise on the labels of the calibration set leaves the observations alone.
        assert same[1]
        assert same[0] or variant == "noisy_labels"
    elif len(calibration[0]) >= 100:
        assert not all(same)


@pytest.mark.medium
@kinds("well_specified")
def test_real_observations_follow_the_simulator_only_where_the_variant_says_so(
    labelled: Task, variant: str | None
) -> None:
    theta, x_o = shared(labelled, "test")
    simulator = labelled.get_simulator()
    x_s = simulator(theta)
    if variant is None:
        assert largest_z(x_s, simulator(theta), paired=True) < 4.5
    if variant == "well_specified":
        assert largest_z(x_s, x_o, paired=True) < 4.5
    elif labelled.name not in SUBTLE:
        assert largest_z(x_s, x_o, paired=True) > 6.0
