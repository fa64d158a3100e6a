"""A diagnosis for the posterior in use counts the alarms that concern it."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE, StackedPosterior, diagnose
from sbi_rope.density import MixturePosterior
from sbi_rope.diagnosis import Diagnosis
from sbi_rope.diagnosis.report import read_for
from tests import problems
from tests.stacks import NPE, NUM_PAIRS, PRIOR, QUIET, Box, problem, rope_of, stacked

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

SHIFTS = {"prior shift: theta_1", "prior shift: theta_2"}
UNLIKE = "batch unlike the calibration pairs"
AFTER = "misspecification after tuning"


class Learned(Box):
    """A box around the parameters of the pairs tells how they are distributed."""

    learns_prior = True


@pytest.fixture(scope="module", autouse=True)
def _fewer_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sbi_rope.diagnosis.misspecification.NUM_DRAWS", 120)
        yield


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


@pytest.fixture(scope="module")
def x_o() -> Tensor:
    return drawn(60, seed=2)[1]


def look(
    rope: RoPE, x_o: Tensor, posterior: MixturePosterior | None = None
) -> Diagnosis:
    return diagnose(
        rope,
        x_o,
        posterior=posterior,
        num_simulations=200,
        num_folds=None,
        seed=0,
        **QUIET,
    )


@pytest.fixture(scope="module")
def of_stack(rope: RoPE, stack: StackedPosterior, x_o: Tensor) -> Diagnosis:
    return look(rope, x_o, stack)


@pytest.fixture(scope="module")
def of_anyone(rope: RoPE, x_o: Tensor) -> Diagnosis:
    return look(rope, x_o)


def names(findings: object) -> set[str]:
    return {finding.name for finding in findings}  # type: ignore[attr-defined]


@pytest.mark.medium
def test_nothing_alarms_about_a_stack_whose_batch_is_drawn_like_its_pairs(
    of_stack: Diagnosis, of_anyone: Diagnosis
) -> None:
    assert names(of_anyone.unexpected) > SHIFTS
    assert of_stack.unexpected == ()
    assert names(of_stack.expected) >= SHIFTS
    assert {one.concerns for one in of_stack.others} == {"RoPE"}
    # They are the same numbers, read by somebody who uses the stack.
    numbers = [(one.name, one.number, one.alarming) for one in of_anyone.findings]
    assert numbers == [
        (one.name, one.number, one.alarming) for one in of_stack.findings
    ]


def test_a_shift_that_the_pairs_do_not_show_is_an_alarm_about_the_stack(
    rope: RoPE, stack: StackedPosterior
) -> None:
    diagnosis = look(rope, drawn(60, seed=2, centre=-0.5)[1], stack)
    assert names(diagnosis.unexpected) >= SHIFTS | {UNLIKE}
    assert f"! {UNLIKE}" in str(diagnosis)


def test_a_shift_that_the_pairs_show_is_an_alarm_where_nothing_has_learned_it(
    stack: StackedPosterior, of_stack: Diagnosis
) -> None:
    report = stack.report
    for other in (
        replace(report, keep_prior=report.names),
        replace(report, probability_of_prior=0.3),
        replace(report, probability_of_prior=None),
    ):
        found = read_for(of_stack, other)
        assert names(found.unexpected) == SHIFTS
    # Nor is it expected where the comparison with the pairs is missing.
    others = tuple(one for one in of_stack.findings if one.name != UNLIKE)
    found = read_for(replace(of_stack, findings=others), report)
    assert names(found.unexpected) == SHIFTS


def test_all_findings_concern_posteriors_with_couplings(
    rope: RoPE, x_o: Tensor, of_anyone: Diagnosis
) -> None:
    coupled = rope.build_posterior(x_o, num_simulations=100, seed=0)
    diagnosis = look(rope, x_o, coupled)
    assert diagnosis.others == ()
    assert names(diagnosis.unexpected) == names(of_anyone.unexpected)
    assert "that concern this posterior are alarming" in diagnosis.verdict
