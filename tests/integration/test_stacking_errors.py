"""What cannot be stacked is refused with a message, before anything is trained."""

from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.baselines import PriorPosterior
from sbi_rope.errors import (
    CouplingError,
    InvalidInputError,
    NotReadyError,
    SamplingError,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.stacking import (
    AmortisedCandidate,
    CouplingCandidate,
    DensityCandidate,
    DiscrepancyCandidate,
    cross_validate,
    stack,
)
from tests import gaussian, problems
from tests.stacks import (
    COUPLINGS,
    FITTED,
    NPE,
    OT_ONLY,
    PRIOR,
    QUIET,
    ROPE,
    finetuned,
    observed,
    problem,
    rope_of,
    stacked,
    the_coupled_stack,
    the_stack,
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
    match = r"at least 2 calibration pairs with different parameters.*got {}"
    for rope, count in ((none, 0), (one, 1), (same, 1)):
        for call in (validated, stacked):
            with pytest.raises(NotReadyError, match=match.format(count)):
                call(rope)


def test_couplings_and_a_batch_belong_together() -> None:
    for call in (validated, stacked):
        with pytest.raises(InvalidInputError, match="`x_o`, a batch"):
            call(rope_of(), candidates=[OT_ONLY, NPE])
        with pytest.raises(InvalidInputError, match="Leave `x_o` out"):
            call(rope_of(), observed(), candidates=[NPE])


def test_bad_lists_of_candidates_are_refused() -> None:
    twice = DensityCandidate(name="NPE", build=finetuned)
    bad: list[tuple[Any, type[Exception], str]] = [
        ([], InvalidInputError, "at least one candidate"),
        ([OT_ONLY, OT_ONLY], InvalidInputError, "names that differ"),
        ([OT_ONLY, NPE, twice], InvalidInputError, "names that differ"),
        ([OT_ONLY, "NPE"], InvalidInputError, "got str"),
        ([OT_ONLY, PriorPosterior(problems.box(2))], InvalidInputError, "Wrap"),
        (OT_ONLY, InvalidInputError, "candidates"),
    ]
    rope = rope_of()
    for candidates, error, match in bad:
        with pytest.raises(error, match=match):
            stacked(rope, observed(), candidates=candidates)


class Own(AmortisedCandidate):
    """A candidate of a user that returns nothing."""

    def __init__(self, name: str) -> None:
        self.name = name

    def parts(self, fold: Any) -> Any:
        return []


def test_a_candidate_of_a_user_needs_a_name_of_its_own_and_a_density() -> None:
    with pytest.raises(InvalidInputError, match="another name"):
        stacked(rope_of(), candidates=[Own("stack")])
    with pytest.raises(InvalidInputError, match="at least one density of 'empty'"):
        stacked(rope_of(), candidates=[Own("empty")])


def test_posteriors_without_a_density_to_score_are_refused() -> None:
    bad: list[tuple[Any, str]] = [
        (problems.vector_field_posterior("fmpe"), "candidate 'bad' with a density"),
        (problems.npe_posterior("mdn", dim=1), r"and theta \(1,\)"),
        (problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (PriorPosterior(gaussian.prior(3)), r"theta \(3,\)"),
        (the_coupled_stack(), "to be amortised"),
        (the_stack(), "equal weights"),
        (stacked(rope_of(), candidates=[FITTED]), "has seen the pairs"),
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


def test_a_coupling_that_has_not_converged_is_an_error_unless_it_is_accepted() -> None:
    coupler = SinkhornCoupler(max_iterations=1, tolerance=1e-9)
    candidates = [*COUPLINGS[:3], PRIOR]
    rope = rope_of(coupler=coupler)
    for call in (validated, stacked):
        with pytest.raises(CouplingError, match=r"have not converged.*max_iterations"):
            call(rope, observed(), candidates=candidates)
    posterior = stacked(
        rope, observed(), candidates=candidates, require_convergence=False
    )
    assert not all(coupling.converged for coupling in posterior.couplings)


def test_candidates_without_mass_in_the_prior_raise_advice_to_add_the_prior() -> None:
    far = PriorPosterior(problems.BoxUniform(torch.ones(2) * 5, torch.ones(2) * 6))
    candidate = DensityCandidate(name="far", build=lambda rope, seed: far, fixed=True)
    with pytest.raises(SamplingError, match="Add the prior to the candidates"):
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


def test_rehearsal_without_tuning_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`rehearsal` of None without tuning"):
        CouplingCandidate(gamma=0.1, tau=1.0, rehearsal=1.0, tuned=False)


def test_anything_but_a_rope_is_refused() -> None:
    for call in (cross_validate, stack):
        match = r"`rope` to be a RoPE; got DirectPosterior\. Make one .*RoPE\(posterior"
        with pytest.raises(InvalidInputError, match=match):
            call(problems.npe_posterior("mdn"))  # type: ignore[arg-type]


def test_rows_that_are_no_pairs_are_refused() -> None:
    rope = rope_of()
    for rows in ([20], [-1], [0.0], 1):
        with pytest.raises(InvalidInputError, match="rows"):
            rope.with_pairs(torch.tensor(rows))


def test_fewer_stored_simulations_than_pairs_are_enough() -> None:
    theta = problems.box(2).sample((10,))
    rope = rope_of(
        problem(30, seed=1),
        simulations=(theta, problems.simulate(theta)),
        finetuner=CalibrationFinetuner(max_num_epochs=2, num_neighbors=3),
    )
    candidates = [ROPE, DiscrepancyCandidate(space="tuned")]
    posterior = stacked(rope, observed(3), candidates=candidates, num_simulations=None)
    assert posterior.report.cross_validation.log_scores.isfinite().all()
