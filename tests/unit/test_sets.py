"""Credible sets: closed forms, the arithmetic of the guarantee, and its coverage."""

import math
from typing import Any

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from sbi_rope import MixturePosterior, StackedPosterior
from sbi_rope.density import Flow
from sbi_rope.density.sets import (
    SetScores,
    is_held,
    joint_scores,
    marginal_ends,
    marginal_scores,
    rank_needed,
)
from sbi_rope.stacking.weights import fold_weights
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.seeds import seeded
from tests import gaussian, problems, stacks

# Calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")
X = torch.tensor([0.5, -1.0])


def exact(prior: Any = None) -> MixturePosterior:
    """Return N(0.8 x, 0.2 I), inside the support of a prior."""
    estimator = Flow.of([gaussian.GaussianEstimator()])
    return MixturePosterior(estimator, gaussian.prior() if prior is None else prior)


@pytest.fixture(scope="module")
def stack() -> StackedPosterior:
    return stacks.small_stack()


# --- without a guarantee ---


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_sets_of_gaussians_are_ellipsoids(level: float) -> None:
    x = torch.stack([X, -X, 0 * X])
    found = exact().credible_set(level, x, num_samples=20_000, seed=0)
    radius = chi2.ppf(level, 2) ** 0.5 * gaussian.POSTERIOR_STD
    angle = torch.linspace(0, 6, 50)[:, None]
    ring = torch.stack([angle.cos(), angle.sin()], dim=2) * radius
    assert found.contains(gaussian.GAIN * x + 0.97 * ring).all()
    assert not found.contains(gaussian.GAIN * x + 1.03 * ring).any()


def test_a_set_ends_at_the_support_of_the_prior() -> None:
    posterior = exact(problems.box(2))
    found = posterior.credible_set(0.99, X, seed=0)
    inside = found.contains(torch.tensor([[0.4, -0.8], [0.4, -1.01], [1.01, -0.8]]))
    assert inside.tolist() == [True, False, False]
    assert found.low[1] > -1.0


def test_intervals_of_gaussians_are_central() -> None:
    x = torch.stack([X, -X])
    found = exact().credible_set(0.9, x, num_samples=50_000, seed=0)
    reach = 1.645 * gaussian.POSTERIOR_STD
    assert torch.allclose(found.low, gaussian.GAIN * x - reach, atol=0.02)
    assert torch.allclose(found.high, gaussian.GAIN * x + reach, atol=0.02)
    row = {"parameter": "theta_2", "low": found.low[1, 1], "high": found.high[1, 1]}
    assert found.as_rows()[3] == {"observation": 1, **row}
    assert "observation 1, theta_2: " in str(found)


def test_shapes_are_those_of_one_observation_or_of_a_batch() -> None:
    posterior = exact().set_default_x(X)
    for x in (None, X, X[None], X.expand(3, 2)):
        event = X.shape if x is None else x.shape
        found = posterior.credible_set(x=x, seed=0)
        assert found.contains_each(torch.stack([found.low, found.high])).all()
        assert not found.contains_each(found.high + 0.01).any()
        for shape in ((), (3,), (2, 3)):
            theta = torch.zeros(*shape, *event)
            assert found.contains(theta).shape == (*shape, *event[:-1])
            assert found.contains_each(theta).shape == theta.shape


# --- the arithmetic of the guarantee ---


def test_joint_scores_count_the_draws_of_higher_density() -> None:
    log_prob, draws = torch.tensor([0.3, -0.2, -9.0, -torch.inf]), torch.randn(50)
    draws[:2] = 0.3
    higher = (draws > log_prob[:, None]).sum(dim=1)
    equal = (draws == log_prob[:, None]).sum(dim=1)
    expected = (higher + equal / 2 + 0.5).double() / 51
    expected[2:] = 1 + draws.min() - log_prob[2:]
    assert torch.allclose(joint_scores(log_prob, draws), expected)


def test_marginal_ends_are_those_of_all_values_with_a_lower_score() -> None:
    draws = torch.randn(2, 30)
    values = (torch.arange(-400, 601) / 100).expand(2, -1)
    scores = marginal_scores(values, draws)
    for limit in (0.3, 0.8, 1.7):
        low, high = marginal_ends(torch.full((2, 1), limit), draws)
        inside = (values >= low - 1e-6) & (values <= high + 1e-6)
        assert torch.equal(inside, scores <= limit + 1e-6)
    # An interval holds its own value also among equal draws, or if all are equal.
    for draws in (torch.randint(3, (30,)), torch.ones(30)):
        values = torch.arange(5.0)
        low, high = marginal_ends(marginal_scores(values, draws), draws)
        assert ((low - 1e-6 <= values) & (values <= high + 1e-6)).all()


def test_marginal_scores_agree_with_ranks_and_go_on_beyond_the_draws() -> None:
    draws = torch.arange(99.0)
    theta = torch.tensor([49.0, 73.0, 0.0, 98.0, 98.0 + 98.0])
    expected = [0, 0.48, 0.98, 0.98, 2.98]
    assert marginal_scores(theta, draws).tolist() == pytest.approx(expected)


def held_by_counting(
    scores: Tensor, fold: Tensor, at_theta: Tensor, level: float
) -> Tensor:
    """Return whether (1 + number of scores at least as high) > alpha (n + 1)."""
    as_high = (scores[:, None] >= at_theta[fold]).sum(dim=0)
    return 1 + as_high > (1 - level) * (len(scores) + 1) + 1e-9


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9])
def test_sets_are_those_of_counting_the_pairs(level: float) -> None:
    for n in (9, 10, 19, 23):
        # Of few values, so that there are ties.
        scores, fold = torch.randint(12, (n,)) / 12, torch.arange(n) % 4
        at_theta = torch.randint(14, (4, 60)) / 12
        expected = held_by_counting(scores, fold, at_theta, level)
        held = is_held(scores, fold, at_theta, rank=rank_needed(level, n))
        assert torch.equal(held, expected)


def with_error(std: float, shift: float = 0.0) -> tuple[Any, Tensor]:
    """Return N(0.8 x + shift, std) of one parameter, and its shift."""
    estimator = gaussian.GaussianEstimator(1)
    estimator.log_std.data.fill_(math.log(std))
    posterior = MixturePosterior(Flow.of([estimator]), gaussian.prior(1))
    _, bias = posterior.posterior_estimator.nets.parameters()
    return posterior, bias.fill_(shift)


@pytest.mark.medium
@pytest.mark.parametrize(("shift", "factor"), [(0, 1), (0, 0.2), (2, 1)])
def test_guaranteed_sets_cover_as_promised_whatever_the_posterior_is(
    shift: float, factor: float
) -> None:
    n, num_new, std = 29, 20, factor * gaussian.POSTERIOR_STD
    fold, covered = torch.arange(n) % 3, []
    posterior, _ = with_error(std, shift)
    folds, shifts = zip(*(with_error(std) for _ in range(3)), strict=True)
    for _ in range(100):
        theta, x = gaussian.labelled(n + num_new, 1)
        x = gaussian.undo(x)
        # The posterior of a fold learns half of its error from the others.
        error = (theta - gaussian.GAIN * x - shift)[:n]
        for k in range(3):
            shifts[k].fill_(shift + error[fold != k].mean() / 2)
        joint, marginal = torch.empty(n).double(), torch.empty(n, 1).double()
        for k, one in enumerate(folds):
            of_fold, x_k = theta[:n][fold == k], x[:n][fold == k]
            draws = one.sample_batched((60,), x_k, **stacks.QUIET)
            log_probs = one.log_prob_batched(torch.cat([of_fold[None], draws]), x_k).T
            joint[fold == k] = joint_scores(log_probs[:, :1], log_probs[:, 1:])[:, 0]
            marginal[fold == k] = marginal_scores(of_fold, draws[..., 0].T)
        numbers: dict[str, Any] = {"weights": torch.empty(3, 1), "num_draws": 60}
        pairs = SetScores(joint=joint, marginal=marginal, fold=fold, **numbers)
        posterior._held_out = lambda pairs=pairs: (pairs, folds)
        sets = [posterior.credible_set(0.9, x[n:], guaranteed=g) for g in (True, False)]
        of_each = sets[0].contains_each(theta[n:])
        covered.append([*(one.contains(theta[n:]) for one in sets), of_each])
    of_sets, plain, of_intervals = (
        float(torch.cat(one).double().mean()) for one in zip(*covered, strict=True)
    )
    # The standard error is 0.9 per cent.
    assert 0.87 <= of_sets <= 0.94
    assert 0.87 <= of_intervals <= 0.96
    assert plain < 0.6 or (shift, factor) == (0, 1)


# --- of a stack ---


def test_scores_of_pairs_are_those_of_stacks_that_have_not_seen_them(
    stack: StackedPosterior,
) -> None:
    known = stack.report
    scores, folds = stack._held_out()
    theta, x = stacks.problem(20, seed=1)
    weights = fold_weights(known.log_scores, known.fold, None)
    for number, posterior in enumerate(folds):
        rows = scores.fold == number
        of_fold, x_k = theta[rows], x[rows]
        each = [one[number].log_prob(of_fold[None], x_k)[0] for one in stack.versions]
        mixed = (torch.stack(each, dim=1) + weights[number].log()).logsumexp(dim=1)
        log_prob = stacks.unnormalised(posterior, of_fold, x_k)
        assert torch.allclose(log_prob[0], mixed.float(), atol=1e-3)
        draws = posterior.sample_batched((2000,), x_k, **stacks.QUIET)
        of_draws = stacks.unnormalised(posterior, draws, x_k)
        again = joint_scores(log_prob.T, of_draws.T)[:, 0]
        # The stack was scored with 40 draws.
        assert (scores.joint[rows] - again).abs().max() < 0.3
        again = marginal_scores(of_fold[..., None], draws.permute(1, 2, 0))[..., 0]
        assert (scores.marginal[rows] - again).abs().max() < 0.4


def test_guaranteed_sets_of_a_batch_are_those_of_each_observation(
    stack: StackedPosterior,
) -> None:
    x = stacks.observed()[0] + torch.tensor([1.0, 0.0, -1.0])[:, None]
    found = stack.credible_set(0.8, x, guaranteed=True, seed=0)
    scores, folds = stack._held_out()
    with seeded(0):
        draws = [one.sample_batched((40,), x, **stacks.QUIET) for one in folds]
    theta = 2.2 * torch.rand(400, 3, 2) - 1.1
    held = found.contains(theta)
    assert not held[(theta.abs() > 1).any(dim=2)].any()
    for i in range(3):
        at_theta = [
            joint_scores(one.log_prob(theta[:, i], x[i]), one.log_prob(own[:, i], x[i]))
            for one, own in zip(folds, draws, strict=True)
        ]
        pairs = scores.joint, scores.fold, torch.stack(at_theta)
        assert torch.equal(held[:, i], held_by_counting(*pairs, 0.8))
        for parameter in range(2):
            ends = [
                marginal_ends(score[[parameter]], draws[fold][:, i, parameter])
                for score, fold in zip(
                    scores.marginal, scores.fold.tolist(), strict=True
                )
            ]
            # Of 20 pairs, 80 % of 21 are 16.8, so that the 17th counts.
            low = sorted(float(end[0]) for end in ends)[-17]
            high = sorted(float(end[1]) for end in ends)[16]
            assert float(found.low[i, parameter]) == pytest.approx(max(low, -1))
            assert float(found.high[i, parameter]) == pytest.approx(min(high, 1))


def test_a_promise_is_what_draws_or_pairs_can_give(stack: StackedPosterior) -> None:
    x, of_npe = stacks.observed()[0], exact().credible_set
    assert "no guarantee" in str(stack.credible_set(0.9, x, seed=0))
    promised = stack.credible_set(0.95, x, guaranteed=True, num_samples=10)
    assert "the 20 calibration pairs" in str(promised)
    of_npe(0.999, X, num_samples=2000)
    with pytest.raises(InvalidInputError, match="at least 2000 for a level"):
        of_npe(0.999, X, num_samples=1999)
    with pytest.raises(InvalidInputError, match=r"stack\(rope\)"):
        of_npe(0.9, X, guaranteed=True)
    for level in (0.99, 0.4):
        with pytest.raises(InvalidInputError, match=rf"0\.5 to 0\.952.*got {level}"):
            stack.credible_set(level, x, guaranteed=True)
