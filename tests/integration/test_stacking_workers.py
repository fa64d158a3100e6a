"""The versions of a stack may be trained in several processes."""

import os
import threading
import warnings
from typing import Any

import pytest
import torch

from sbi_rope import RoPE
from sbi_rope.errors import InvalidInputError, RoPEWarning, warn_user
from sbi_rope.mixture import Part, part_of_prior
from sbi_rope.stacking import AmortisedCandidate, DensityCandidate, stack
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench
from tests import problems
from tests.stacks import (
    FINETUNED,
    NUM_FOLDS,
    PRIOR,
    QUIET,
    finetuned,
    problem,
    rope_of,
    stacked,
)

# Whatever else warns here, because there are few pairs and simulations.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def restless(rope: RoPE, seed: int) -> Any:
    """Simulate and warn in every version."""
    theta, _ = rope.source.from_prior(7, 7, lambda x: x, progress=False)
    warn_user(f"Simulated {len(theta)} times.")
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


def test_several_processes_give_the_numbers_calls_and_warnings_of_one() -> None:
    theta, x = problem(8, seed=5)
    scores, drawn, calls, warned = [], [], [], []
    for num_workers in (1, 2):
        rope = rope_of()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = stacked(
                rope,
                candidates=[PRIOR, FINETUNED, RESTLESS, Shared()],
                num_workers=num_workers,
            )
        warned.append(
            [
                (str(one.message), one.category)
                for one in caught
                if one.category in (RoPEWarning, FutureWarning)
            ]
        )
        calls.append(result.report.provenance.num_simulator_calls)
        scores.append(result.report.cross_validation.log_scores)
        torch.manual_seed(0)
        drawn.append(result.sample_batched((5,), x=x, **QUIET))
        assert torch.isfinite(result.log_prob_batched(theta[None], x=x)).all()
    for of_one, of_two in (scores, drawn):
        # Sums may be rounded differently with another number of threads.
        torch.testing.assert_close(of_one, of_two, rtol=1e-4, atol=1e-4)
    assert calls[0] == calls[1]
    assert warned[0] == warned[1]
    assert ("Simulated 7 times.", RoPEWarning) in warned[0]
    assert ("Something of another package.", FutureWarning) in warned[0]


@pytest.mark.slow
@pytest.mark.parametrize("embedding", ["linear", "none"])
def test_default_candidates_simulate_what_they_share_once(embedding: str) -> None:
    scores, calls = [], []
    for num_workers in (1, 2):
        result = stack(
            rope_of(problem(12, seed=1), embedding=embedding),
            num_folds=NUM_FOLDS,
            num_workers=num_workers,
            seed=0,
            **QUIET,
        )
        calls.append(result.report.provenance.num_simulator_calls)
        scores.append(result.report.cross_validation.log_scores)
    assert calls[0] == calls[1]
    # Rounding grows in the course of a training.
    torch.testing.assert_close(*scores, rtol=0.05, atol=0.05)


def test_what_cannot_be_sent_to_a_process_is_refused_before_anything_is_trained() -> (
    None
):
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


@pytest.mark.parametrize(
    ("build", "match"),
    [
        (fails, r"'it' raised ArithmeticError: no solution"),
        pytest.param(
            dies,
            r"trained in 2 processes; got Terminated.*Use fewer `num_workers`",
            marks=pytest.mark.slow,  # because other tests need new processes then
        ),
    ],
)
def test_an_error_and_the_end_of_a_process_are_reported(build: Any, match: str) -> None:
    candidate = DensityCandidate(name="it", build=build)
    with pytest.raises(InvalidInputError, match=f"(?s){match}"):
        stacked(rope_of(), candidates=[PRIOR, candidate], num_workers=2)
