"""The versions of a stack may be trained in several processes."""

import os
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE, parallel
from sbi_rope.errors import InvalidInputError, RoPEWarning, warn_user
from sbi_rope.mixture import Part, part_of_prior
from sbi_rope.stacking import (
    AmortisedCandidate,
    DensityCandidate,
    default_candidates,
    stack,
)
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench
from tests import problems
from tests.stacks import (
    FINETUNED,
    NUM_FOLDS,
    OT_ONLY,
    PRIOR,
    QUIET,
    ROPE,
    finetuned,
    in_this_process,
    observed,
    problem,
    rope_of,
    stacked,
    validated,
)

# Whatever else warns here, because there are few pairs and simulations.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def restless(rope: RoPE, seed: int) -> Any:
    """Simulate and warn in every version."""
    rope.source.from_prior(7, 7, lambda x: x, progress=False)
    warn_user("Simulated 7 times.")
    warnings.warn("Something of another package.", FutureWarning, stacklevel=2)
    return finetuned(rope, seed)


RESTLESS = DensityCandidate(name="restless", build=restless)


class Shared(AmortisedCandidate):
    """It needs simulations that all versions share."""

    name = "shared"

    def prepare(self, bench: Workbench) -> None:
        _ = bench.simulations

    def parts(self, fold: Fold) -> list[Part]:
        theta, _ = fold.bench.simulations
        width = theta.abs().max(dim=0).values
        return [
            part_of_prior(problems.BoxUniform(-width, width), fold.bench.x.shape[1:])
        ]


@dataclass(frozen=True)
class Outcome:
    """What is to be the same, wherever versions are trained."""

    scores: Tensor
    num_calls: int
    num_dropped: int
    warned: set[tuple[str, type[Warning]]]


def outcome(rope: RoPE, x_o: Tensor | None = None, **options: Any) -> Outcome:
    calls, dropped = rope.num_simulator_calls, rope.num_dropped_simulations
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scores = validated(rope, x_o, **options).log_scores
    return Outcome(
        scores=scores,
        num_calls=rope.num_simulator_calls - calls,
        num_dropped=rope.num_dropped_simulations - dropped,
        warned={
            (str(one.message), one.category)
            for one in caught
            if issubclass(one.category, RoPEWarning | FutureWarning)
        },
    )


def assert_same(of_one: Outcome, of_several: Outcome) -> None:
    # Sums may be rounded differently with another number of threads.
    torch.testing.assert_close(of_one.scores, of_several.scores, rtol=1e-4, atol=1e-4)
    assert of_one.num_calls == of_several.num_calls
    assert of_one.num_dropped == of_several.num_dropped
    assert of_one.warned == of_several.warned


def sometimes(theta: Tensor) -> Tensor:
    """Simulate, but not every time."""
    return problems.simulate(theta).where(torch.rand(len(theta), 1) < 0.8, torch.nan)


def stored(count: int) -> tuple[Tensor, Tensor]:
    theta, _ = problem(count, seed=6)
    return theta, problems.simulate(theta)


MINE = (PRIOR, FINETUNED, RESTLESS, Shared())
REHEARSED = CalibrationFinetuner(
    max_num_epochs=2, simulations_per_target=5, rehearsal=1.0
)
CASES: dict[str, dict[str, Any]] = {
    "the user's own": {"simulator": sometimes, "candidates": MINE},
    "a limited number": {"num_simulations": 60, "candidates": [PRIOR, FINETUNED]},
    "rehearsal": {"finetuner": REHEARSED, "candidates": [PRIOR, FINETUNED]},
    "default": {"candidates": default_candidates()},
    "stored": {"simulations": stored(1000), "candidates": [PRIOR, FINETUNED]},
    "a batch": {"x_o": observed(), "candidates": [PRIOR, FINETUNED, ROPE, OT_ONLY]},
}


@pytest.mark.medium
@pytest.mark.parametrize("case", CASES)
def test_copies_of_folds_give_the_scores_calls_and_warnings_of_the_folds(
    case: str,
) -> None:
    options = dict(CASES[case])
    given = {
        name: options.pop(name) for name in ("x_o", "candidates") if name in options
    }
    # What `quick` patches is not patched in other processes.
    with patch("sbi_rope.stacking.workers.in_workers", in_this_process):
        of_one, of_several = (
            outcome(rope_of(**options), num_workers=count, **given) for count in (1, 2)
        )
    assert_same(of_one, of_several)
    if case == "the user's own":
        assert of_one.num_dropped > 0
        assert ("Simulated 7 times.", RoPEWarning) in of_one.warned
        assert ("Something of another package.", FutureWarning) in of_one.warned


@pytest.mark.medium
def test_two_processes_give_the_outcome_of_one() -> None:
    def simulator(theta: Tensor) -> Tensor:  # which has no name of its own
        return problems.simulate(theta)

    candidates = [PRIOR, FINETUNED, RESTLESS]
    of_one, of_two = (
        outcome(
            rope_of(simulator=parallel(simulator, num_workers=2)),
            candidates=candidates,
            num_workers=count,
        )
        for count in (1, 2)
    )
    assert_same(of_one, of_two)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let torch use one thread, because others round differently."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_default_candidates_of_two_processes_are_those_of_one() -> None:
    of_one, of_two = (
        stack(
            rope_of(problem(12, seed=1)),
            num_folds=NUM_FOLDS,
            num_workers=count,
            seed=0,
            **QUIET,
        ).report
        for count in (1, 2)
    )
    assert (
        of_one.provenance.num_simulator_calls == of_two.provenance.num_simulator_calls
    )
    torch.testing.assert_close(
        of_one.cross_validation.log_scores,
        of_two.cross_validation.log_scores,
        rtol=1e-4,
        atol=1e-4,
    )


def test_what_cannot_be_sent_is_refused_before_anything_is_trained() -> None:
    lock = threading.Lock()
    started = []

    def holds(theta: torch.Tensor) -> torch.Tensor:
        with lock:
            return problems.simulate(theta)

    def build(rope: RoPE, seed: int) -> Any:
        started.append(lock)

    match = r"can be sent to other processes; got .*lock.*`num_workers` at 1"
    holding = DensityCandidate(name="holding", build=build)
    for rope, candidate in (
        (rope_of(simulator=holds), FINETUNED),
        (rope_of(), holding),
    ):
        calls = rope.num_simulator_calls
        with pytest.raises(InvalidInputError, match=match):
            stacked(rope, candidates=[PRIOR, candidate], num_workers=2)
        assert rope.num_simulator_calls == calls
    assert not started


def fails(rope: RoPE, seed: int) -> Any:
    raise ArithmeticError("no solution")


def dies(rope: RoPE, seed: int) -> Any:
    os._exit(1)


class FailsOddly(AmortisedCandidate):
    """It raises an error that cannot be sent to another process."""

    name = "odd"

    def parts(self, fold: Fold) -> list[Part]:
        raise OddError(lock=threading.Lock())


class OddError(Exception):
    def __init__(self, *, lock: Any) -> None:
        super().__init__("no solution", lock)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("candidate", "match"),
    [
        (FailsOddly(), r"got OddError: .*no solution.*line \d+, in parts"),
        pytest.param(
            DensityCandidate(name="fails", build=fails),
            r"'fails' raised ArithmeticError: no solution",
            marks=pytest.mark.slow,  # after an error others need new processes
        ),
        pytest.param(
            DensityCandidate(name="dies", build=dies),
            r"trained in 2 processes; got Terminated.*use fewer `num_workers`",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_error_and_the_end_of_a_process_are_reported(
    candidate: AmortisedCandidate, match: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"(?s){match}"):
        stacked(rope_of(), candidates=[PRIOR, candidate], num_workers=2)
