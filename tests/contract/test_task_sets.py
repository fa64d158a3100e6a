"""The labelled sets of every task: reproducible, disjoint, of the law they should have.

A contract is checked for all tasks and those of their variants that could break it:

* ``EVERY``: all variants, in what they change: who is observed, and what is seen.
* ``OWN_CODE``: the standard real process, and the variants that run code of the task's
  own. Elsewhere a variant that all tasks have runs the methods of ``Task``, the same
  for all: one task with a process to draw from and one with recordings stand for the
  rest.

What is refused is tried in ``tests/faults``.

Sets are drawn once for all tests that read them (:func:`shared`); what must be
reproduced is drawn anew and compared with them.
"""

import functools
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS
from tests.tasks import (
    SUBTLE,
    at_most,
    draw,
    largest_z,
    make,
    rows_of,
    same_rows,
)

# Variants whose calibration set follows another law than the test set.
ANOTHER_CALIBRATION_LAW = {
    "biased_calibration",
    "noisy_labels",
    "sensor_settings",
    "flipped",
}
# Where the code behind a common variant is; a task that overrides it runs its own.
METHODS = {
    "prior_shift": ("_keep", "_labelled_set"),
    "biased_calibration": ("_keep", "_labelled_set"),
    "noisy_labels": ("get_calibration_set", "_labelled_set"),
    "well_specified": ("_well_specified_process", "_labelled_set"),
}
# One process that is drawn and one that is recorded.
FOR_THE_REST = {"pendulum", "light_tunnel_sensors"}
# Tasks whose real process takes a tenth of a second for some hundred observations.
SLOW_PROCESS = {"cs", "light_tunnel", "sir"}

Kind = tuple[str, str | None]


def runs_own_code(name: str, variant: str | None) -> bool:
    """Whether no other task's tests run what this variant of this task runs."""
    if variant not in COMMON_VARIANTS or name in FOR_THE_REST:
        return True
    return any(
        getattr(TASKS[name], method) is not getattr(Task, method)
        for method in METHODS[variant]
    )


def shows_a_law_of_its_own(name: str, variant: str | None) -> bool:
    """Whether its observations are not those of the standard process, row by row.

    That noisy labels leave observations as they are is tested for all tasks.
    """
    return variant != "noisy_labels" or runs_own_code(name, variant)


def kinds(chosen: list[Kind]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        ("name", "variant"),
        [
            pytest.param(
                name, variant, id=name if variant is None else f"{name}-{variant}"
            )
            for name, variant in chosen
        ],
    )


ALL_KINDS = [
    (name, variant)
    for name, task in TASKS.items()
    for variant in (None, *task.variants)
]
EVERY = kinds(ALL_KINDS)
OWN_CODE = kinds([kind for kind in ALL_KINDS if runs_own_code(*kind)])
OWN_LAW = kinds([kind for kind in ALL_KINDS if shows_a_law_of_its_own(*kind)])
PARTS = pytest.mark.parametrize("part", ["calibration", "test"])


@pytest.fixture
def labelled(name: str, variant: str | None, root: Path | None) -> Task:
    return make(name, variant=variant, root=root)


def size_of(name: str, variant: str | None, part: str, seed: int) -> int:
    """Number of observations in a shared set; two blocks of a drawn one or more."""
    if seed != 0 or (variant == "noisy_labels" and name in SLOW_PROCESS):
        return at_most(130, name)
    if part == "calibration":
        return at_most(250, name)
    # Where the process differs from the simulator, 400 observations tell by 13 standard
    # errors or more. To tell that it does not takes as many as there is time for.
    few = name in SLOW_PROCESS and variant != "well_specified"
    return at_most(400 if few else 1000, name)


@functools.cache
def _drawn(
    name: str, variant: str | None, root: Path | None, part: str, seed: int
) -> tuple[Tensor, Tensor]:
    task = make(name, variant=variant, root=root)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return draw(task, part, size_of(name, variant, part, seed), seed=seed)


def shared(task: Task, part: str, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return a set that all tests share; for reading only."""
    return _drawn(task.name, task.variant, task.root, part, seed)


@pytest.fixture(autouse=True, scope="module")
def _forget() -> Iterator[None]:
    """Let go of the shared sets after the last test."""
    yield
    _drawn.cache_clear()


# One set -----------------------------------------------------------------------------


@EVERY
@PARTS
def test_a_set_has_the_shapes_asked_for(labelled: Task, part: str) -> None:
    theta, x = shared(labelled, part)
    n = size_of(labelled.name, labelled.variant, part, 0)
    assert theta.shape == (n, labelled.theta_dim)
    assert x.shape == (n, *labelled.x_shape)
    assert theta.dtype == x.dtype == torch.float32
    assert torch.isfinite(x).all()
    assert within_support(labelled.get_prior(), theta).all()


@EVERY
@PARTS
def test_a_set_has_no_observation_twice(labelled: Task, part: str) -> None:
    _, x = shared(labelled, part)
    assert len(set(rows_of(x))) == len(x)


@EVERY
@PARTS
def test_a_set_begins_with_the_smaller_set(labelled: Task, part: str) -> None:
    small, large = draw(labelled, part, 7), shared(labelled, part)
    assert torch.equal(small[0], large[0][:7])
    assert torch.equal(small[1], large[1][:7])


@OWN_CODE
@PARTS
def test_a_set_is_the_same_for_the_same_seed(labelled: Task, part: str) -> None:
    first, second = draw(labelled, part, 20, seed=1), shared(labelled, part, seed=1)
    assert torch.equal(first[0], second[0][:20])
    assert torch.equal(first[1], second[1][:20])


@OWN_CODE
@PARTS
def test_a_set_differs_between_seeds(labelled: Task, part: str) -> None:
    first, second = shared(labelled, part, seed=0), shared(labelled, part, seed=1)
    assert not torch.equal(first[0][:20], second[0][:20])
    assert not torch.equal(first[1][:20], second[1][:20])


@OWN_CODE
@PARTS
def test_a_set_leaves_the_global_random_states_alone(labelled: Task, part: str) -> None:
    before = torch.get_rng_state(), random.getstate(), np.random.get_state()[1]  # noqa: NPY002
    draw(labelled, part, 5)
    after = torch.get_rng_state(), random.getstate(), np.random.get_state()[1]  # noqa: NPY002
    assert torch.equal(before[0], after[0])
    assert before[1] == after[1]
    assert np.array_equal(before[2], after[2])


@OWN_CODE
@PARTS
def test_a_set_is_the_same_whatever_torchs_default_dtype_and_device(
    labelled: Task, part: str
) -> None:
    expected = shared(labelled, part)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            theta, x = draw(labelled, part, 5)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(theta, expected[0][:5])
    assert torch.equal(x, expected[1][:5])


@OWN_CODE
@PARTS
def test_a_set_does_not_depend_on_the_global_seed(labelled: Task, part: str) -> None:
    expected = shared(labelled, part)
    torch.manual_seed(2)
    assert torch.equal(draw(labelled, part, 5)[1], expected[1][:5])


@OWN_CODE
@PARTS
def test_sizes_and_seeds_may_be_integers_of_numpy(labelled: Task, part: str) -> None:
    theta, x = draw(labelled, part, np.int64(5), seed=np.uint8(0))
    assert torch.equal(theta, shared(labelled, part)[0][:5])
    assert torch.equal(x, shared(labelled, part)[1][:5])


# Two sets ----------------------------------------------------------------------------


def share_labels_at_most(task: Task, *, seeds: tuple[int, int]) -> None:
    calibration = shared(task, "calibration", seed=seeds[0])
    test = shared(task, "test", seed=seeds[1])
    assert same_rows(calibration[1], test[1]) == 0
    assert same_rows(calibration[0], test[0]) <= 0.01 * len(test[0])


@EVERY
def test_calibration_and_test_sets_share_no_observation(labelled: Task) -> None:
    share_labels_at_most(labelled, seeds=(0, 0))


@OWN_CODE
@pytest.mark.parametrize("seeds", [(0, 1), (1, 0)])
def test_sets_of_different_seeds_share_no_observation(
    labelled: Task, seeds: tuple[int, int]
) -> None:
    share_labels_at_most(labelled, seeds=seeds)


@OWN_CODE
@pytest.mark.parametrize("seed", [0, 1])
def test_simulations_under_a_seed_share_no_parameter_with_its_sets(
    labelled: Task, seed: int
) -> None:
    torch.manual_seed(seed)
    theta = labelled.get_prior().sample(torch.Size((1000,)))
    for part in ("calibration", "test"):
        assert same_rows(theta, shared(labelled, part, seed=seed)[0]) == 0


@OWN_CODE
def test_nothing_is_printed(labelled: Task, capfd: pytest.CaptureFixture[str]) -> None:
    theta, _ = labelled.get_calibration_set(3)
    x, _ = labelled.get_simulator()(theta), labelled.get_test_set(3)
    labelled.get_embedding_net(light=True)(x)
    assert capfd.readouterr() == ("", "")


# Laws --------------------------------------------------------------------------------


@OWN_LAW
def test_calibration_and_test_sets_follow_one_law(
    labelled: Task, variant: str | None
) -> None:
    calibration, test = shared(labelled, "calibration"), shared(labelled, "test")
    same_theta = largest_z(calibration[0], test[0]) < 4.5
    same_x = largest_z(calibration[1], test[1]) < 4.5
    few = len(calibration[0]) < 100
    if variant not in ANOTHER_CALIBRATION_LAW:
        assert same_theta
        assert same_x
    elif variant != "noisy_labels" and not few:
        assert not (same_theta and same_x)


@OWN_LAW
def test_real_law_is_the_simulated_law_only_where_the_task_says_so(
    labelled: Task, variant: str | None
) -> None:
    theta, x_o = shared(labelled, "test")
    x_s = labelled.get_simulator()(theta)
    if variant == "well_specified":
        assert labelled.has_data
        assert largest_z(x_s, x_o) < 4.5
    elif labelled.name not in SUBTLE:
        assert largest_z(x_s, x_o) > 6.0


@pytest.mark.parametrize(("name", "variant"), [(name, None) for name in TASKS])
def test_simulations_of_the_same_parameters_follow_one_law(labelled: Task) -> None:
    theta, _ = shared(labelled, "test")
    simulator = labelled.get_simulator()
    assert largest_z(simulator(theta), simulator(theta)) < 4.5
