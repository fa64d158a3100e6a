"""What cannot be stacked is refused with a message, before anything is trained."""

from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.baselines import PriorPosterior
from sbi_rope.errors import (
    InvalidInputError,
    NotReadyError,
    SamplingError,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.stacking import (
    Candidate,
    DensityCandidate,
    DiscrepancyCandidate,
    cross_validate,
    stack,
)
from tests import gaussian, problems
from tests.stacks import (
    FITTED,
    NPE,
    PRIOR,
    QUIET,
    finetuned,
    observed,
    problem,
    rope_of,
    stacked,
    the_stack,
    trained,
    uneven,
    validated,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def test_too_few_pairs_are_refused() -> None:
    theta, x = problem(6, seed=1)
    one = rope_of((theta[:1], x[:1]))
    none = one.with_pairs(torch.arange(0))
    same = rope_of((theta[:1].expand(6, -1), x))
    match = r"at least 2 calibration pairs with different parameters or groups; got {}"
    for rope, count in ((none, 0), (one, 1), (same, 1)):
        for call in (validated, stacked):
            with pytest.raises(NotReadyError, match=match.format(count)):
                call(rope)


def test_bad_lists_of_candidates_are_refused() -> None:
    twice = DensityCandidate(name="NPE", build=finetuned)
    bad: list[tuple[Any, str]] = [
        ([], r"got \[\]"),
        ([PRIOR, NPE, twice], "different names"),
        ([PRIOR, "NPE"], "Candidate; got"),
        ([PRIOR, PriorPosterior(problems.box(2))], "Candidate; got"),
        (PRIOR, "candidates"),
    ]
    rope = rope_of()
    for candidates, match in bad:
        with pytest.raises(InvalidInputError, match=match):
            stacked(rope, candidates=candidates)


class Own(Candidate):
    """A candidate of a user that returns nothing."""

    def __init__(self, name: str) -> None:
        self.name = name

    def parts(self, fold: Any) -> Any:
        return []


def test_a_candidate_of_a_user_needs_a_name_of_its_own_and_a_density() -> None:
    with pytest.raises(InvalidInputError, match="none of them 'stack'"):
        stacked(rope_of(), candidates=[Own("stack")])
    with pytest.raises(InvalidInputError, match="at least one density of 'empty'"):
        stacked(rope_of(), candidates=[Own("empty")])


def test_posteriors_without_a_density_to_score_are_refused() -> None:
    bad: list[tuple[Any, str]] = [
        (problems.vector_field_posterior("fmpe"), "candidate 'bad' with a density"),
        (problems.npe_posterior("mdn", dim=1), r"and theta \(1,\)"),
        (problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (PriorPosterior(gaussian.prior(3)), r"theta \(3,\)"),
        (trained().build_posterior(observed(), seed=0), "to answer any x"),
        (the_stack(), "equal weight"),
        (stacked(rope_of(), candidates=[FITTED]), "equal weight"),
        (None, "NoneType"),
    ]
    rope = rope_of()
    for posterior, match in bad:
        # One that is built for each fold is checked in the same way as a fixed one.
        for fixed in (True, False) if posterior is None else (True,):
            candidate = DensityCandidate(
                name="bad", build=lambda *_, made=posterior: made, fixed=fixed
            )
            with pytest.raises(UnsupportedPosteriorError, match=match):
                validated(rope, candidates=[PRIOR, candidate], num_folds=2)


def test_a_rope_of_a_vector_field_is_refused_before_anything_is_simulated() -> None:
    rope = RoPE(problems.vector_field_posterior("fmpe"), simulator=problems.simulate)
    rope.append_calibration(*problem(6, seed=1))
    source: Any = rope.source
    of_the_check = source.num_calls
    for x_o in (None, observed()):
        with pytest.raises(UnsupportedPosteriorError, match="Train NPE instead"):
            stack(rope, x_o, **QUIET)
    assert source.num_calls == of_the_check


def test_a_rope_of_a_stack_is_refused() -> None:
    with pytest.raises(UnsupportedPosteriorError, match="StackedPosterior"):
        RoPE(the_stack(), simulator=uneven)


def test_candidates_without_mass_in_the_prior_raise_advice_to_add_the_prior() -> None:
    far = PriorPosterior(problems.BoxUniform(torch.ones(2) * 5, torch.ones(2) * 6))
    candidate = DensityCandidate(name="far", build=lambda rope, seed: far, fixed=True)
    with pytest.raises(SamplingError, match="add the prior to the candidates"):
        stacked(rope_of(), candidates=[candidate])
    assert stacked(rope_of(), candidates=[candidate, PRIOR]).candidate_weights


def test_pairs_that_cannot_be_simulated_are_named_by_their_parameters() -> None:
    theta, x = problem(6, seed=1)
    bad = theta[4]

    def fails(parameters: torch.Tensor) -> torch.Tensor:
        missing = (parameters == bad).all(dim=1, keepdim=True)
        return problems.simulate(parameters).where(~missing, torch.nan)

    with pytest.raises(SimulationError, match=rf"\[\[{bad[0]:.4g}, {bad[1]:.4g}\]\]"):
        stacked(rope_of((theta, x), simulator=fails))


def test_the_folds_to_train_on_must_be_fewer_than_all() -> None:
    with pytest.raises(InvalidInputError, match="below the number of folds, 3; got 3"):
        validated(rope_of(), candidates=[NPE], num_training_folds=3)


def test_anything_but_a_rope_is_refused() -> None:
    for call in (cross_validate, stack):
        match = "`rope` to be a RoPE; got"
        with pytest.raises(InvalidInputError, match=match):
            call(problems.npe_posterior("mdn"))  # type: ignore[arg-type]


def test_fewer_stored_simulations_than_pairs_are_enough() -> None:
    theta = problems.box(2).sample((10,))
    rope = rope_of(
        problem(30, seed=1),
        simulations=(theta, problems.simulate(theta)),
        finetuner=CalibrationFinetuner(max_num_epochs=2, num_neighbors=3),
    )
    posterior = stacked(rope, candidates=[DiscrepancyCandidate(space="tuned")])
    assert posterior.report.cross_validation.log_scores.isfinite().all()
