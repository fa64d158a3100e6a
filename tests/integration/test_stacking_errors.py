"""What cannot be stacked is refused in words, and before anything is trained."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.baselines import PriorPosterior
from sbi_rope.errors import (
    CouplingError,
    InvalidInputError,
    InvalidTypeError,
    NotReadyError,
    RoPEError,
    SamplingError,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.stacking import (
    AmortisedCandidate,
    CouplingCandidate,
    DensityCandidate,
    DiscrepancyCandidate,
    FinetunedCandidate,
    cross_validate,
    stack,
)
from tests import gaussian, problems
from tests.stacks import (
    COUPLINGS,
    NPE,
    NUM_OBSERVED,
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


@pytest.mark.parametrize("num_pairs", [1, 0])
def test_too_few_pairs_are_refused(num_pairs: int) -> None:
    rope = (
        rope_of(problem(num_pairs, seed=1))
        if num_pairs
        else rope_of(problem(1, seed=1)).with_pairs(torch.arange(0))
    )
    for call in (cross_validate, stack):
        with pytest.raises(NotReadyError, match="at least 2 calibration pairs"):
            call(rope, **QUIET)


def test_pairs_of_one_parameter_are_too_few() -> None:
    theta, x = problem(6, seed=1)
    rope = rope_of((theta[:1].expand(6, -1), x))
    with pytest.raises(NotReadyError, match=r"with different parameters.*got 1"):
        stacked(rope)


def test_couplings_and_a_batch_belong_together() -> None:
    for call in (validated, stacked):
        with pytest.raises(InvalidInputError, match="`x_o`, a batch"):
            call(rope_of(), candidates=[OT_ONLY, NPE])
        with pytest.raises(InvalidInputError, match="Leave `x_o` out"):
            call(rope_of(), observed(), candidates=[NPE])


@pytest.mark.parametrize(
    ("candidates", "error", "match"),
    [
        ([], InvalidInputError, "at least one candidate"),
        ([OT_ONLY, OT_ONLY], InvalidInputError, "names that differ"),
        (
            [OT_ONLY, NPE, DensityCandidate(name="NPE", build=finetuned)],
            InvalidInputError,
            "names that differ",
        ),
        ([OT_ONLY, "NPE"], InvalidTypeError, "got str"),
        ([OT_ONLY, PriorPosterior(problems.box(2))], InvalidTypeError, "Wrap"),
        (OT_ONLY, InvalidTypeError, "candidates"),
    ],
)
def test_bad_lists_of_candidates_are_refused(
    candidates: Any, error: type[Exception], match: str
) -> None:
    for call in (validated, stacked):
        with pytest.raises(error, match=match):
            call(rope_of(), observed(), candidates=candidates)


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


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: problems.vector_field_posterior("fmpe"), "density to score"),
        (lambda: problems.npe_posterior("mdn", dim=1), r"and theta \(1,\)"),
        (lambda: problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (lambda: PriorPosterior(gaussian.prior(3)), r"theta \(3,\)"),
        (lambda: the_coupled_stack(), "to be amortised"),
        (lambda: the_stack(), "equal weights"),
        (lambda: None, "NoneType"),
    ],
)
@pytest.mark.parametrize("fixed", [True, False])
def test_posteriors_without_a_density_to_score_are_refused(
    make: Callable[[], Any], match: str, fixed: bool
) -> None:
    candidate = DensityCandidate(
        name="bad", build=lambda rope, seed: make(), fixed=fixed
    )
    with pytest.raises(UnsupportedPosteriorError, match=match):
        validated(rope_of(), candidates=[PRIOR, candidate], num_folds=2)


@pytest.mark.parametrize("method", ["fmpe", "npse"])
def test_a_vector_field_has_no_density_to_score_and_nothing_is_simulated(
    method: str,
) -> None:
    rope = RoPE(problems.vector_field_posterior(method), simulator=problems.simulate)
    rope.append_calibration(*problem(6, seed=1))

    def refuse(theta: torch.Tensor) -> torch.Tensor:
        raise AssertionError("simulated")

    source: Any = rope.source
    source.function = refuse
    for x_o in (None, observed()):
        with pytest.raises(UnsupportedPosteriorError, match="train NPE instead"):
            stack(rope, x_o, **QUIET)


def test_a_stack_cannot_be_repaired_again() -> None:
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


def test_candidates_without_mass_in_the_prior_are_told_to_take_the_prior() -> None:
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

    with pytest.raises(SimulationError, match=f"{float(bad[0]):.6f}"[:6]):
        stacked(rope_of((theta, x), simulator=fails))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"num_folds": 1}, "num_folds"),
        ({"num_folds": 2.5}, "num_folds"),
        ({"num_folds": True}, "num_folds"),
        ({"num_simulations": 0}, "num_simulations"),
        ({"pseudo_count": -1.0}, "pseudo_count"),
        ({"pseudo_count": math.nan}, "pseudo_count"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"x_o": torch.zeros(5, 4)}, "x_o"),
        ({"x_o": torch.zeros(0, 3)}, "x_o"),
        ({"x_o": torch.full((5, 3), math.nan)}, "x_o"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], match: str) -> None:
    options = {"x_o": observed(), "candidates": [OT_ONLY], **options}
    for call in (validated, stacked):
        with pytest.raises(InvalidInputError, match=match):
            call(rope_of(), **options)


@pytest.mark.parametrize(
    "options", [{"unseen": "maybe"}, {"tail_mass": 2.0}, {"tail_mass": -0.1}]
)
def test_bad_arguments_of_the_posterior_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        stacked(rope_of(), candidates=[NPE], **options)


@pytest.mark.parametrize("bad", [5, 0, -1, 1.5, True])
def test_folds_to_train_on_are_fewer_than_all(bad: Any) -> None:
    with pytest.raises(InvalidInputError, match="num_training_folds"):
        validated(rope_of(), candidates=[NPE], num_training_folds=bad)


@pytest.mark.parametrize(
    ("theta", "x"),
    [
        (torch.zeros(3, 3), torch.zeros(3, 3)),
        (torch.zeros(2, 2), torch.zeros(3, 3)),
        (torch.full((3, 2), math.nan), torch.zeros(3, 3)),
        (torch.zeros(3, 2), torch.zeros(3, 4)),
    ],
)
def test_pairs_of_other_shapes_have_no_candidate_densities(
    theta: torch.Tensor, x: torch.Tensor
) -> None:
    for posterior in (the_stack(), the_coupled_stack()):
        with pytest.raises(InvalidInputError, match=r"`theta`|`x`"):
            posterior.candidate_log_probs(theta, x)


def test_whole_numbers_have_the_densities_of_these_numbers() -> None:
    for posterior in (the_stack(), the_coupled_stack()):
        theta, x = torch.zeros(NUM_OBSERVED, 2), observed()
        expected = posterior.candidate_log_probs(theta, x)
        assert torch.equal(posterior.candidate_log_probs(theta.long(), x), expected)
        assert torch.equal(posterior.candidate_log_probs(theta.double(), x), expected)


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (CouplingCandidate, {"gamma": 0.0, "tau": 1.0}),
        (CouplingCandidate, {"gamma": math.nan, "tau": 1.0}),
        (CouplingCandidate, {"gamma": 0.1, "tau": 1.1}),
        (CouplingCandidate, {"gamma": 0.1, "tau": 1.0, "rehearsal": -1.0}),
        (
            CouplingCandidate,
            {"gamma": 0.1, "tau": 1.0, "rehearsal": 1.0, "tuned": False},
        ),
        (CouplingCandidate, {"gamma": 0.1, "tau": 1.0, "tuned": "yes"}),
        (CouplingCandidate, {"gamma": 0.1, "tau": 1.0, "cost_scale": "real"}),
        (DensityCandidate, {"name": "mine", "build": "posterior"}),
        (DensityCandidate, {"name": "stack", "build": finetuned}),
        (DensityCandidate, {"name": 3, "build": finetuned}),
        (DensityCandidate, {"name": "mine", "build": finetuned, "fixed": "yes"}),
        (DiscrepancyCandidate, {"space": "output"}),
        (DiscrepancyCandidate, {"learn_prior": "yes"}),
        (FinetunedCandidate, {"space": "x"}),
    ],
)
def test_settings_of_candidates_outside_their_range_are_refused(
    make: Any, options: dict[str, Any]
) -> None:
    with pytest.raises(RoPEError):
        make(**options)


@pytest.mark.parametrize("call", [cross_validate, stack])
def test_something_else_than_rope_is_refused(call: Callable[..., Any]) -> None:
    for bad in (problems.npe_posterior("mdn"), None):
        with pytest.raises(InvalidTypeError, match="`rope` to be a RoPE"):
            call(bad, observed())


@pytest.mark.parametrize(
    "rows",
    [torch.tensor([20]), torch.tensor([-1]), torch.tensor([0.0]), torch.ones(())],
)
def test_rows_that_are_no_pairs_are_refused(rows: torch.Tensor) -> None:
    rope = rope_of()
    with pytest.raises(InvalidInputError, match="rows"):
        rope.with_pairs(rows)


def test_simulations_may_be_few_and_pairs_many() -> None:
    theta = problems.box(2).sample((10,))
    rope = rope_of(
        problem(30, seed=1),
        simulations=(theta, problems.simulate(theta)),
        finetuner=CalibrationFinetuner(max_num_epochs=2, num_neighbors=3),
    )
    candidates = [ROPE, DiscrepancyCandidate(space="tuned")]
    posterior = stacked(rope, observed(3), candidates=candidates, num_simulations=None)
    assert posterior.report.cross_validation.log_scores.isfinite().all()
