"""What can be stacked, and what is refused."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.baselines import PriorPosterior
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    LogProbUnavailableError,
    UnsupportedPosteriorError,
)
from sbi_rope.stacking import (
    CouplingCandidate,
    DensityCandidate,
    cross_validate,
    default_candidates,
    stack,
)
from tests import problems
from tests.stacks import (
    COUPLINGS,
    NPE,
    NUM_OBSERVED,
    OT_ONLY,
    PRIOR,
    QUICK,
    QUIET,
    observed,
    parameters,
    problem,
    quick_finetuned,
    same,
    stacked,
    the_rope,
    the_scores,
    the_stack,
    trained,
    uneven,
    unnormalised,
    validate,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def test_candidates_come_in_any_order_and_are_named() -> None:
    scores = validate(the_rope(), candidates=(NPE, COUPLINGS[0], PRIOR, OT_ONLY))
    assert scores.names == (
        "RoPE (gamma 0.2, tau 1)",
        "OT-only (gamma 0.2, tau 0.5)",
        "NPE",
        "prior",
    )
    assert scores.families == ("RoPE", "OT-only", "NPE", "prior")
    for k, name in enumerate(scores.names):
        expected = the_scores().scores_of(name)
        assert torch.allclose(scores.log_scores[:, k], expected, atol=1e-3)


def test_the_default_candidates_can_be_stacked() -> None:
    rope = trained(num_pairs=6)
    candidates = default_candidates(gammas=(0.3,), taus=(0.5,))
    posterior = stacked(rope, candidates=candidates, num_folds=2)
    assert list(posterior.candidate_weights)[3:] == [
        "prior",
        "NPE",
        "tuning-only",
        "fine-tuned NPE",
    ]
    assert posterior.report.cross_validation.log_scores.isfinite().all()


def test_a_rope_that_rehearsed_is_not_trained_again() -> None:
    rope = trained(finetuner=replace(QUICK, rehearsal=2.0))
    candidates = [
        CouplingCandidate(gamma=0.2, tau=1.0, rehearsal=rehearsal)
        for rehearsal in (None, 2.0, 0.0)
    ]
    estimator: Any = stacked(rope, candidates=candidates).posterior_estimator
    nets = [net.net for net in estimator.coupled[0].nets]
    own, same_one, other = map(parameters, nets)
    assert same(own, parameters(rope.tuned_embedding_net))
    assert same(own, same_one)
    assert not same(own, other)


def test_a_user_may_add_a_trained_posterior_of_another_family() -> None:
    another = problems.npe_posterior("maf", "none")
    before = copy.deepcopy(another.posterior_estimator.state_dict())
    built = []

    def build(rope: RoPE, seed: int) -> Any:
        built.append(rope)
        return another

    candidate = DensityCandidate(name="older", build=build, fixed=True)
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate))
    assert len(built) == 1
    scores = posterior.report.cross_validation
    expected = unnormalised(another, scores.theta, scores.x)[0]
    assert torch.allclose(scores.scores_of("older").float(), expected, atol=1e-4)
    after = another.posterior_estimator.state_dict()
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_a_stack_does_not_change_with_the_posteriors_it_was_made_of() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "none"))
    candidate = DensityCandidate(
        name="older", build=lambda rope, seed: another, fixed=True
    )
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)
    theta = problems.box(2).sample((NUM_OBSERVED,))
    expected = unnormalised(posterior, theta, posterior.x_o)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, posterior.x_o), expected)


def test_a_posterior_in_training_mode_is_scored_in_evaluation_mode() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "linear"))
    another.posterior_estimator.train()
    candidate = DensityCandidate(
        name="older", build=lambda rope, seed: another, fixed=True
    )
    scores = validate(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)
    another.posterior_estimator.eval()
    expected = unnormalised(another, scores.theta, scores.x)[0]
    assert torch.allclose(scores.scores_of("older").float(), expected, atol=1e-4)


def test_a_trainer_sees_the_pairs_of_the_other_folds_and_at_last_all() -> None:
    seen = []

    def build(rope: RoPE, seed: int) -> Any:
        theta, x = rope.calibration
        seen.append((len(theta), len(x), seed))
        # Its RoPE is tuned on the same pairs.
        assert rope.tuned_embedding_net is not None
        return quick_finetuned(rope, seed)

    candidate = DensityCandidate(name="mine", build=build)
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate))
    assert [n for n, _, _ in seen] == [n for _, n, _ in seen] == [16] * 5 + [20]
    assert len({seed for _, _, seed in seen}) == 6
    # Its posterior in the end is the one trained on all pairs.
    alone = quick_finetuned(the_rope(), seen[-1][2])
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    found = estimator.candidate_log_probs(theta, posterior.x_o)[:, 1].float()
    assert torch.allclose(
        found, unnormalised(alone, theta, posterior.x_o)[0], atol=1e-4
    )


def test_what_the_user_hands_over_is_left_as_it_was() -> None:
    rope = trained()
    x_o = observed()
    theta, x = rope.calibration
    held = [x_o, theta, x]
    net, coupler, finetuner = rope.tuned_embedding_net, rope.coupler, rope.finetuner
    npe = problems.npe_posterior("mdn")
    state = copy.deepcopy(npe.posterior_estimator.state_dict())
    before = [value.clone() for value in held]
    untouched = rope.build_posterior(x_o, num_simulations=50, seed=3).weights.clone()
    stacked(rope, x_o=x_o)
    assert all(map(torch.equal, held, before))
    assert all(map(torch.equal, rope.calibration, before[1:]))
    assert same(parameters(rope.tuned_embedding_net), parameters(net))
    assert (rope.coupler, rope.finetuner) == (coupler, finetuner)
    after = npe.posterior_estimator.state_dict()
    assert all(torch.equal(state[key], after[key]) for key in state)
    again = rope.build_posterior(x_o, num_simulations=50, seed=3).weights
    assert torch.equal(again, untouched)


@pytest.mark.parametrize(
    ("candidates", "error", "match"),
    [
        ([NPE, PRIOR], InvalidInputError, "at least one CouplingCandidate"),
        ([], InvalidInputError, "at least one CouplingCandidate"),
        ([OT_ONLY, OT_ONLY], InvalidInputError, "names that differ"),
        (
            [OT_ONLY, NPE, DensityCandidate(name="NPE", build=quick_finetuned)],
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
    for call in (validate, stacked):
        with pytest.raises(error, match=match):
            call(the_rope(), candidates=candidates)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: problems.vector_field_posterior("fmpe"), "density to score"),
        (lambda: problems.vector_field_posterior("npse"), "density to score"),
        (
            lambda: problems.npe_posterior("mdn", dim=1),
            r"got x \(3,\) and theta \(1,\)",
        ),
        (lambda: problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (lambda: problems.gaussian_posterior(), "MixturePosterior"),
        (lambda: the_stack(), "StackedPosterior"),
        (lambda: None, "NoneType"),
    ],
)
@pytest.mark.parametrize("fixed", [True, False])
def test_posteriors_without_a_density_to_score_are_refused(
    make: Callable[[], Any],
    match: str,
    fixed: bool,
) -> None:
    candidate = DensityCandidate(
        name="bad", build=lambda rope, seed: make(), fixed=fixed
    )
    with pytest.raises(UnsupportedPosteriorError, match=match):
        validate(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)


def test_a_stack_cannot_be_repaired_again() -> None:
    with pytest.raises(UnsupportedPosteriorError, match="StackedPosterior"):
        RoPE(the_stack(), simulator=uneven)


@pytest.mark.parametrize("method", ["fmpe", "npse"])
def test_rope_of_a_vector_field_has_no_density_to_score(method: str) -> None:
    rope = RoPE(
        problems.vector_field_posterior(method),
        simulator=problems.simulate,
        finetuner=CalibrationFinetuner(num_steps=2, simulations_per_target=2),
    )
    rope.append_calibration(*problem(2, 6, seed=1)).train(**QUIET)
    errors = (LogProbUnavailableError, UnsupportedPosteriorError)
    for call in (validate, stacked):
        with pytest.raises(errors):
            call(rope, candidates=[OT_ONLY])


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
    for call in (validate, stacked):
        with pytest.raises(InvalidInputError, match=match):
            call(the_rope(), **{"candidates": [OT_ONLY], "num_folds": 2, **options})


@pytest.mark.parametrize("bad", [5, 0, -1, 1.5, True])
def test_folds_to_train_on_are_fewer_than_all(bad: Any) -> None:
    with pytest.raises(InvalidInputError, match="num_training_folds"):
        validate(the_rope(), candidates=[OT_ONLY], num_training_folds=bad)


@pytest.mark.parametrize(
    "options", [{"unseen": "maybe"}, {"tail_mass": 2.0}, {"tail_mass": -0.1}]
)
def test_bad_arguments_of_the_posterior_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        stacked(the_rope(), candidates=[OT_ONLY], num_folds=2, **options)


@pytest.mark.parametrize("call", [cross_validate, stack])
def test_something_else_than_rope_is_refused(call: Callable[..., Any]) -> None:
    for bad in (problems.npe_posterior("mdn"), None):
        with pytest.raises(InvalidTypeError, match="`rope` to be a RoPE"):
            call(bad, observed())
