"""A diagnosis for the posterior in use counts the alarms that concern it."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE, StackedPosterior, diagnose
from sbi_rope.diagnosis import Diagnosis
from tests import problems
from tests.stacks import NPE, NUM_PAIRS, PRIOR, QUIET, Box, problem, rope_of, stacked

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")

SHIFTS = {"prior shift: theta_1", "prior shift: theta_2"}
UNLIKE = "batch unlike the calibration pairs"


class Learned(Box):
    """A box around the parameters of the pairs tells how they are distributed."""

    learns_prior = True


def drawn(n: int, *, seed: int, centre: float = 0.5) -> tuple[Tensor, Tensor]:
    """Return pairs whose parameters are in a part of the prior."""
    theta = 0.3 * problem(n, seed=seed)[0] + centre
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return theta, problems.simulate(theta) + 0.4


@pytest.fixture(scope="module")
def rope() -> RoPE:
    return rope_of(drawn(NUM_PAIRS, seed=1)).train(seed=0, **QUIET)


@pytest.fixture(scope="module")
def stack(rope: RoPE) -> StackedPosterior:
    return stacked(rope, candidates=[PRIOR, NPE, Learned()])


def look(rope: RoPE, posterior: Any = None, *, centre: float = 0.5) -> Diagnosis:
    x_o = drawn(60, seed=2, centre=centre)[1]
    options = {"num_simulations": 200, "num_folds": None, "seed": 0, **QUIET}
    return diagnose(rope, x_o, posterior=posterior, **options)


def alarms(diagnosis: Diagnosis) -> set[str]:
    return {finding.name for finding in diagnosis.alarming}


@pytest.mark.medium
def test_nothing_alarms_about_a_stack_whose_batch_is_drawn_like_its_pairs(
    rope: RoPE, stack: StackedPosterior
) -> None:
    of_anyone, of_stack = look(rope), look(rope, stack)
    assert alarms(of_anyone) > SHIFTS
    assert alarms(of_stack) == set()
    assert all("This is expected" in of_stack[name].sentence for name in SHIFTS)
    # They are the same numbers, without those about couplings and the tuned net.
    numbers = {one.name: one.value for one in of_anyone.findings}
    assert len(of_stack.findings) == len(numbers) - 4
    assert all(one.value == numbers[one.name] for one in of_stack.findings)
    # A posterior with couplings is what all of them are about.
    x_o = drawn(60, seed=2)[1]
    coupled = rope.build_posterior(x_o, num_simulations=100, seed=0)
    assert look(rope, coupled).findings == of_anyone.findings[:-1]


@pytest.mark.medium
def test_a_shift_is_an_alarm_where_the_stack_has_not_learned_it(
    rope: RoPE, stack: StackedPosterior
) -> None:
    assert alarms(look(rope, stack, centre=-0.5)) == SHIFTS | {UNLIKE}
    other = copy.copy(stack)
    for change in ({"keeps_prior": True}, {"probability_of_prior": 0.3}):
        other.report = replace(stack.report, **change)
        assert alarms(look(rope, other)) == SHIFTS
