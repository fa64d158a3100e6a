"""A stack that is recalibrated by versions that have not seen a fold."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import sbi_rope
from sbi_rope import MixturePosterior
from sbi_rope._bounds import bounds_of_prior
from sbi_rope.errors import InvalidInputError, UnsupportedPosteriorError
from sbi_rope.mixture import average
from sbi_rope.recalibration import Recalibration
from sbi_rope.recalibration.estimator import RecalibratedEstimator
from sbi_rope.recalibration.factors import HeldOutMixture
from sbi_rope.recalibration.recalibration import recalibrate
from sbi_rope.stacking import DensityCandidate, StackedPosterior
from sbi_rope.stacking.recalibrating import pairs_of_folds
from tests import problems
from tests.stacks import (
    FITTED,
    NPE,
    PRIOR,
    ROPE,
    problem,
    rope_of,
    stacked,
)

pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def near_zero(n: int = 20) -> tuple[Tensor, Tensor]:
    """Pairs of parameters near zero, for which the prior is too wide."""
    theta = 0.3 * problems.box(2).sample((n,))
    return theta, problems.simulate(theta) + 0.4


@pytest.fixture(scope="module")
def stacks() -> tuple[StackedPosterior, StackedPosterior]:
    """A stack of candidates that are too wide, and the same recalibrated."""
    torch.manual_seed(0)
    rope = rope_of(near_zero())
    plain, recalibrated = (
        stacked(rope, candidates=[PRIOR, NPE], recalibrate=flag)
        for flag in (False, True)
    )
    return plain, recalibrated


@pytest.fixture
def recalibrated(
    stacks: tuple[StackedPosterior, StackedPosterior],
) -> StackedPosterior:
    return stacks[1]


def recalibration_of(posterior: StackedPosterior) -> Recalibration:
    found = posterior.report.recalibration
    assert found is not None
    return found


@pytest.mark.medium
def test_the_scores_and_weights_are_those_of_the_stack_without(
    stacks: tuple[StackedPosterior, StackedPosterior],
) -> None:
    plain, recalibrated = stacks
    assert plain.report.recalibration is None
    assert recalibrated.candidate_weights == plain.candidate_weights
    assert recalibrated.report.score == plain.report.score
    theta, x = problem(4, seed=9)
    assert torch.equal(
        recalibrated.candidate_log_probs(theta, x), plain.candidate_log_probs(theta, x)
    )
    assert f"{recalibration_of(recalibrated).gain:+.2f} nats" in str(
        recalibrated.report
    )


def test_draws_are_moved_by_the_factors_and_keep_their_order(
    stacks: tuple[StackedPosterior, StackedPosterior],
) -> None:
    plain, recalibrated = stacks
    found = recalibration_of(recalibrated)
    assert found.is_used
    assert isinstance(recalibrated.posterior_estimator, RecalibratedEstimator)
    _, x = problem(3, seed=9)
    draws = []
    for posterior in (plain, recalibrated):
        torch.manual_seed(0)
        draws.append(posterior.sample_batched((500,), x, show_progress_bars=False))
    assert torch.equal(draws[0].argsort(dim=0), draws[1].argsort(dim=0))
    assert (draws[1].abs() < 1).all()
    # The logits of parameters between -1 and 1.
    width = [(2 * some.double().atanh()).std(dim=0) for some in draws]
    ratio = (width[1] / width[0]).mean(dim=0)
    torch.testing.assert_close(ratio, found.factors, rtol=1e-3, atol=0.0)


def test_it_is_saved_and_answers_sets_as_any_other_stack(
    recalibrated: StackedPosterior, tmp_path: Path
) -> None:
    theta, x = problem(4, seed=9)
    recalibrated.save(tmp_path / "stack.npz")
    loaded = sbi_rope.load(tmp_path / "stack.npz")
    expected = recalibrated.log_prob_batched(theta, x)
    assert torch.equal(loaded.log_prob_batched(theta, x), expected)
    assert str(loaded.report) == str(recalibrated.report)
    for guaranteed in (False, True):
        found = recalibrated.credible_set(0.8, x[0], guaranteed=guaranteed, seed=0)
        assert found.volume > 0


@pytest.mark.medium
def test_the_posterior_of_one_observation_of_a_batch_is_recalibrated_too() -> None:
    torch.manual_seed(0)
    rope, (_, x_o) = rope_of(near_zero()), near_zero(25)
    posterior = stacked(rope, x_o, candidates=[ROPE, PRIOR], recalibrate=True)
    assert recalibration_of(posterior).is_used
    theta, _ = problem(5, seed=9)
    one = posterior[2].log_prob(theta)
    torch.testing.assert_close(one, posterior.log_prob(theta, x=x_o[2]))


def test_each_fold_is_left_out_with_four_others_at_most() -> None:
    for count, expected in ((3, 3), (4, 6), (5, 10), (8, 16)):
        pairs = pairs_of_folds(count)
        assert len(pairs) == expected
        for number in range(count):
            assert sum(number in pair for pair in pairs) == min(4, count - 1)


@pytest.mark.medium
def test_labels_on_a_bound_of_the_prior_say_nothing_about_the_spread() -> None:
    torch.manual_seed(0)
    theta, x = near_zero(14)
    edges = torch.tensor([[1.0, 0.1], [-0.2, 1.0], [-1.0, 0.3], [0.2, -1.0]])
    theta, x = torch.cat([theta, edges]), torch.cat([x, problems.simulate(edges) + 0.4])
    posterior = stacked(rope_of((theta, x)), candidates=[PRIOR, NPE], recalibrate=True)
    found = recalibration_of(posterior)
    assert len(found.levels_before) == 14
    assert 0 < found.gain < 2  # with labels on bounds it would be above 20
    assert float(found.factors.max()) < 1


def test_a_recalibrated_mixture_is_no_candidate_of_a_stack() -> None:
    rope = rope_of()
    prior = rope.npe.prior
    narrow = RecalibratedEstimator(
        average([rope.npe]).posterior_estimator,
        torch.full((2,), 0.5),
        bounds_of_prior(prior),
    )
    candidate = DensityCandidate(
        name="narrow",
        build=lambda rope, seed: MixturePosterior(narrow, prior),
        fixed=True,
    )
    with pytest.raises(UnsupportedPosteriorError, match="its factors would be lost"):
        stacked(rope, candidates=[PRIOR, candidate])


@pytest.mark.medium
def test_what_cannot_be_recalibrated_is_refused_before_any_training() -> None:
    theta, x = problem(20, seed=1)
    noisy = rope_of((theta[:0], x[:0])).append_calibration(theta, x, theta_std=0.1)
    with pytest.raises(InvalidInputError, match="exact labels to recalibrate"):
        stacked(noisy, recalibrate=True)
    with pytest.raises(InvalidInputError, match="at least 10 calibration pairs"):
        stacked(rope_of((theta[:9], x[:9])), recalibrate=True)
    with pytest.raises(InvalidInputError, match="at least 3 folds to recalibrate"):
        stacked(rope_of(), num_folds=2, recalibrate=True)
    on_a_bound = torch.where(torch.arange(20)[:, None] % 2 == 0, theta, 1.0)
    with pytest.raises(InvalidInputError, match="on a bound of the prior; got 9"):
        stacked(rope_of((on_a_bound[:18], x[:18])), recalibrate=True)
    mixed = rope_of(problem(0, seed=1), family="mnpe")
    parameters = problems.mixed_prior(2).sample((10,))
    mixed.append_calibration(parameters, problems.simulate(parameters))
    with pytest.raises(UnsupportedPosteriorError, match="continuous parameters"):
        stacked(mixed, recalibrate=True)


@pytest.mark.medium
def test_the_mixture_that_is_scored_on_a_fold_has_not_seen_its_labels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.manual_seed(0)
    theta, x = near_zero()
    changed = theta.clone()
    changed[7] = 0.9  # far from the others, so that the box around them is larger
    kept: list[list[HeldOutMixture]] = []

    def keep(folds: list[HeldOutMixture], *args: Any, **options: Any) -> Recalibration:
        kept.append(folds)
        return recalibrate(folds, *args, **options)

    monkeypatch.setattr("sbi_rope.stacking.recalibrating.recalibrate", keep)
    for labels in (theta, changed):
        stacked(rope_of((labels, x)), candidates=[FITTED], recalibrate=True)
    ones = torch.ones(1, 2)
    for first, second in zip(*kept, strict=True):
        holds = bool((first.theta == theta[7]).all(dim=1).any())
        # At the same parameters, which are outside the smaller boxes. With a single
        # candidate the weights of the stack do not depend on the labels.
        somewhere = torch.full_like(first.theta, 0.6)
        found = [
            replace(fold, theta=somewhere).log_prob(ones) for fold in (first, second)
        ]
        assert torch.allclose(*found) == holds
