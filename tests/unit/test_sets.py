"""Credible sets: closed forms, the arithmetic of the guarantee, and its coverage."""

import itertools
import math
import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from sbi_rope import MixturePosterior, StackedPosterior
from sbi_rope._random import seeded
from sbi_rope.density import Flow
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics import coverage_curve_of
from sbi_rope.sets import CredibleSet, Guarantee
from sbi_rope.sets.conformal import (
    interval_of,
    is_held,
    joint_scores,
    marginal_ends,
    marginal_scores,
)
from sbi_rope.stacking import StackingReport
from sbi_rope.stacking.cross_validation import fold_weights
from sbi_rope.stacking.posterior import fold_posterior, mixture_of
from tests import gaussian, problems, stacks

# Calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")
X = torch.tensor([0.5, -1.0])


def exact(prior: Any = None) -> MixturePosterior:
    """Return N(0.8 x, 0.2 I), inside the support of a prior."""
    estimator = Flow.of([gaussian.GaussianEstimator()])
    return MixturePosterior(estimator, gaussian.prior() if prior is None else prior)


@pytest.fixture(scope="module")
def stack() -> StackedPosterior:
    return stacks.small_stack()


@pytest.fixture(scope="module")
def x() -> Tensor:
    return stacks.observed()[0]


# --- without a guarantee ---


def test_the_set_of_a_gaussian_is_its_ellipsoid() -> None:
    for level in (0.5, 0.9):
        found = exact().credible_set(level, X, num_samples=20_000, seed=0)
        radius = chi2.ppf(level, 2) ** 0.5 * gaussian.POSTERIOR_STD
        angle = torch.linspace(0, 6, 50)
        ring = torch.stack([angle.cos(), angle.sin()], dim=1) * radius
        centre = gaussian.GAIN * X
        assert found.contains(centre + 0.97 * ring).all()
        assert not found.contains(centre + 1.03 * ring).any()
        area = math.pi * radius**2
        assert abs(found.volume - area) < 4 * found.volume_error + 0.02 * area
        assert found.volume_error < 0.02 * area
        # The prior has standard deviations of one.
        assert math.isclose(found.volume_z, found.volume)
        assert float(found.inside.double().mean()) == pytest.approx(level)
        assert torch.equal(found.inside, found.contains(found.draws))


def test_a_set_ends_at_the_support_of_the_prior() -> None:
    posterior = exact(problems.box(2))
    found = posterior.credible_set(0.99, X, seed=0)
    assert not found.contains(torch.tensor([[0.4, -1.01], [1.01, -0.8]])).any()
    assert found.contains(torch.tensor([0.4, -0.8]))
    intervals = posterior.credible_intervals(0.99, X, seed=0)
    assert intervals.low[1] > -1.0
    # With standard deviations of 1 / sqrt(3).
    assert found.volume_z == pytest.approx(3 * found.volume, rel=1e-5)


def test_intervals_of_a_gaussian_are_central() -> None:
    found = exact().credible_intervals(0.9, X, num_samples=50_000, seed=0)
    reach = 1.645 * gaussian.POSTERIOR_STD
    assert torch.allclose(found.low, gaussian.GAIN * X - reach, atol=0.02)
    assert torch.allclose(found.high, gaussian.GAIN * X + reach, atol=0.02)
    names = [row["parameter"] for row in found.as_rows()]
    assert names == ["theta_1", "theta_2"]


def test_intervals_of_a_batch_are_those_of_each_observation() -> None:
    posterior, x = exact(), torch.stack([X, -X, 0 * X])
    found = posterior.credible_intervals_batched(0.9, x, num_samples=50_000, seed=0)
    assert found.low.shape == found.high.shape == (3, 2)
    one = posterior.credible_intervals(0.9, -X, num_samples=50_000, seed=0)
    assert torch.allclose(found[1].low, one.low, atol=0.03)
    assert torch.allclose(found[1].high, one.high, atol=0.03)
    middle = (found.low + found.high) / 2
    assert found.contains(middle).tolist() == [[True, True]] * 3
    assert found.contains(torch.stack([middle, middle.flip(0)])).shape == (2, 3, 2)


def test_the_default_x_and_the_seed_are_used() -> None:
    posterior = exact().set_default_x(X)
    one, same = posterior.credible_set(seed=3), posterior.credible_set(0.9, X, seed=3)
    assert one.volume == same.volume
    assert one.volume != posterior.credible_set(seed=4).volume
    state = torch.get_rng_state()
    posterior.credible_intervals(seed=3)
    assert torch.equal(torch.get_rng_state(), state)


def test_intervals_contain_what_is_between_their_ends() -> None:
    posterior = exact()
    found = posterior.credible_intervals(0.9, X, seed=0)
    inside = torch.stack([found.low, found.high, (found.low + found.high) / 2])
    assert found.contains(inside).all()
    outside = torch.stack([found.low - 0.01, found.high])
    assert found.contains(outside).tolist() == [[False, False], [True, True]]
    of_all = posterior.credible_set(0.9, X, seed=0)
    for shape in ((), (3,), (2, 3)):
        theta = torch.zeros(*shape, 2)
        assert found.contains(theta).shape == (*shape, 2)
        assert of_all.contains(theta).shape == shape


# --- the arithmetic of the guarantee ---


def test_joint_scores_count_the_draws_of_higher_density() -> None:
    log_prob, draws = torch.tensor([[0.3, -0.2, -9.0]]), torch.randn(1, 50)
    draws[0, :2] = 0.3
    for value, score in zip(
        log_prob[0], joint_scores(log_prob, draws)[0].tolist(), strict=True
    ):
        higher, equal = (draws > value).sum(), (draws == value).sum()
        expected = float(higher + equal / 2 + 0.5) / 51
        if value < draws.min():
            expected = 1 + float(draws.min() - value)
        assert score == pytest.approx(expected, rel=1e-5)


def test_marginal_ends_are_those_of_all_values_with_a_lower_score() -> None:
    for draws in (torch.randn(2, 30), torch.randint(3, (2, 30)).float()):
        values = (torch.arange(-400, 601) / 100).expand(2, -1)
        scores = marginal_scores(values, draws)
        for limit in (0.3, 0.8, 1.7):
            low, high = marginal_ends(torch.full((2, 1), limit), draws)
            inside = (values >= low - 1e-6) & (values <= high + 1e-6)
            assert torch.equal(inside, scores <= limit + 1e-6)


def test_marginal_scores_agree_with_ranks_and_go_on_beyond_the_draws() -> None:
    draws = torch.arange(99.0)
    theta = torch.tensor([49.0, 98.0, 98.0 + 98.0])
    assert marginal_scores(theta, draws).tolist() == pytest.approx([0, 0.98, 2.98])
    same = torch.ones(5)
    ends = marginal_ends(marginal_scores(torch.tensor([1.0, 2.0]), same), same)
    assert ends[0].tolist() == [1.0, -math.inf]
    assert ends[1].tolist() == [1.0, math.inf]


def held_by_counting(
    scores: Tensor, fold: Tensor, at_theta: Tensor, level: float
) -> list[bool]:
    """Return whether (1 + number of scores at least as high) > alpha (n + 1)."""
    held = []
    for column in at_theta.T:
        as_high = sum(
            float(score) >= float(column[k])
            for score, k in zip(scores, fold.tolist(), strict=True)
        )
        held.append(1 + as_high > (1 - level) * (len(scores) + 1) + 1e-9)
    return held


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9])
def test_sets_are_those_of_counting_the_pairs(level: float) -> None:
    for n in (9, 10, 19, 23):
        # Of few values, so that there are ties.
        scores, fold = torch.randint(12, (n,)) / 12, torch.arange(n) % 4
        at_theta = torch.randint(14, (4, 60)) / 12
        expected = held_by_counting(scores, fold, at_theta, level)
        assert is_held(scores, fold, at_theta, level=level).tolist() == expected


def test_intervals_contain_the_set_of_counting_the_pairs() -> None:
    for n, level in ((9, 0.9), (19, 0.8), (30, 0.6)):
        fold = torch.arange(n) % 3
        draws, theta = torch.randn(3, 40), torch.linspace(-5, 5, 801)
        scores = 1.3 * torch.rand(n)
        at_theta = marginal_scores(theta.expand(3, -1), draws)
        held = is_held(scores.double(), fold, at_theta, level=level)
        ends = [
            marginal_ends(s[None], draws[k]) for s, k in zip(scores, fold, strict=True)
        ]
        low, high = (torch.stack(some) for some in zip(*ends, strict=True))
        low, high = interval_of(low, high, level=level)
        inside = (theta >= low) & (theta <= high)
        assert not (held & ~inside).any()
        # The interval is no larger than the hull of the set needs.
        assert inside.sum() <= held.sum() + 0.1 * len(theta)


# --- coverage ---


NOISE: dict[str, tuple[float, float]] = {
    # The shift of the mean, and the factor of the standard deviation.
    "right": (0.0, 1.0),
    "too narrow": (0.0, 0.2),
    "shifted": (2.0, 1.0),
}


@pytest.mark.medium
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("right", marks=pytest.mark.slow),
        "too narrow",
        pytest.param("shifted", marks=pytest.mark.slow),
    ],
)
def test_guaranteed_sets_cover_as_promised_whatever_the_posterior_is(name: str) -> None:
    n, num_folds, level, num_draws, repetitions = 29, 5, 0.9, 60, 500
    shift, factor = NOISE[name]
    std = factor * gaussian.POSTERIOR_STD
    fold = torch.arange(n) % num_folds
    inside_set = inside_interval = plain = 0
    for _ in range(repetitions):
        theta, x = (both[:, 0] for both in gaussian.labelled(n + 1, 1))
        centre = gaussian.GAIN * gaussian.undo(x) + shift
        # The posterior of a fold learns half of its error from the others.
        error = theta[:n] - centre[:n]
        learnt = torch.stack([error[fold != k].mean() / 2 for k in range(num_folds)])
        of_pairs = centre[:n] + learnt[fold]
        of_new = centre[n] + learnt
        means = torch.cat([of_pairs, of_new])[:, None]
        truth = torch.cat([theta[:n], theta[n].expand(num_folds)])[:, None]
        draws = means + std * torch.randn(n + num_folds, num_draws)
        log_prob = -((truth - means) ** 2) / (2 * std**2)
        joint = joint_scores(log_prob, -((draws - means) ** 2) / (2 * std**2))[:, 0]
        inside_set += bool(is_held(joint[:n], fold, joint[n:, None], level=level))
        plain += bool(joint[n] <= level)
        marginal = marginal_scores(truth, draws)[:n]
        low, high = marginal_ends(marginal, draws[n:][fold])
        low, high = interval_of(low, high, level=level)
        inside_interval += bool(low <= theta[n] <= high)
    # Three standard errors of 500 repetitions are 4 per cent.
    assert 0.86 <= inside_set / repetitions <= 0.955
    assert 0.86 <= inside_interval / repetitions <= 0.975
    if name != "right":
        assert plain / repetitions < 0.6


def test_the_bound_is_that_of_the_theorem() -> None:
    promised = Guarantee(level=0.9, num_pairs=50, num_folds=5)
    assert promised.lower_bound == pytest.approx(1 - 0.2 - 2 * 0.8 / 11)
    many = Guarantee(level=0.9, num_pairs=10_000, num_folds=5)
    assert many.lower_bound == pytest.approx(1 - 0.2 - 1.6 / 2001)
    alone = Guarantee(level=0.9, num_pairs=20, num_folds=20)
    assert alone.lower_bound == pytest.approx(0.8)
    assert Guarantee(level=0.5, num_pairs=10, num_folds=5).lower_bound == 0.0
    assert "at least 0.655" in str(promised)


# --- of a stack ---


def test_scores_of_pairs_are_those_of_stacks_that_have_not_seen_them(
    stack: StackedPosterior,
) -> None:
    known = stack.report
    scores = known.set_scores
    assert scores is not None
    theta, x_cal = stacks.problem(20, seed=1)
    weights = fold_weights(known.log_scores, known.fold, None)
    for number in range(known.num_folds):
        rows = known.fold == number
        density = mixture_of(stack.versions, weights[number], version=number)
        posterior = fold_posterior(density, stack.prior)
        draws = posterior.sample_batched((2000,), x_cal[rows], **stacks.QUIET)
        log_prob = posterior.log_prob_batched(theta[rows], x_cal[rows]).T
        of_draws = posterior.log_prob_batched(draws, x_cal[rows]).T
        again = joint_scores(log_prob, of_draws)[:, 0]
        # The stack was scored with 40 draws.
        assert (scores.joint[rows] - again).abs().max() < 0.3
        one_by_one = marginal_scores(theta[rows][..., None], draws.permute(1, 2, 0))
        assert (scores.marginal[rows] - one_by_one[..., 0]).abs().max() < 0.4
    # Inside the draws, they are the levels that coverage is computed from.
    curve = coverage_curve_of(scores.marginal.clamp_max(1.0))
    assert (curve.average - known.coverage.average).abs().max() < 0.15
    assert scores.num_draws == 40


def test_a_guaranteed_set_is_that_of_counting_the_held_out_scores(
    stack: StackedPosterior, x: Tensor
) -> None:
    found = stack.credible_set(0.8, x, guaranteed=True, seed=0)
    rule: Any = found.rule
    theta = 2.2 * torch.rand(200, 2) - 1.1
    log_prob = torch.stack(
        [one.log_prob(theta, x=x, norm_posterior=False) for one in rule.posteriors]
    )
    at_theta = joint_scores(log_prob, rule.draws)
    assert rule.draws.shape == (5, 40)
    known = stack.report
    weights = fold_weights(known.log_scores, known.fold, None)
    near = (theta.abs() <= 1).all(dim=1)
    for number in range(5):
        each = torch.stack(
            [
                one[number].log_prob(theta[:, None], x[None])[:, 0]
                for one in stack.versions
            ]
        )
        expected = (each + weights[number].log()[:, None]).logsumexp(dim=0)
        assert (log_prob[number] - expected)[near].abs().max() < 1e-3
    held = held_by_counting(rule.scores, rule.fold, at_theta, 0.8)
    assert 0 < sum(held) < len(held)
    assert found.contains(theta).tolist() == (torch.tensor(held) & near).tolist()
    box = float(found.contains(theta).double().mean()) * 2.2**2
    assert abs(found.volume - box) < 4 * found.volume_error + 0.5


def test_guaranteed_intervals_of_a_batch_are_those_of_each_observation(
    stack: StackedPosterior, x: Tensor
) -> None:
    batch = torch.stack([x + 1.0, x, x - 1.0])
    found = stack.credible_intervals_batched(0.8, batch, guaranteed=True, seed=0)
    assert found.guarantee is not None
    rule: Any = stack.credible_set(0.8, x, guaranteed=True, seed=0).rule
    marginal = stack.report.set_scores.marginal
    with seeded(0):
        draws = [
            one.sample_batched((40,), batch, **stacks.QUIET) for one in rule.posteriors
        ]
    for number, parameter in itertools.product(range(3), range(2)):
        ends = [
            marginal_ends(score[[parameter]], draws[fold][:, number, parameter])
            for score, fold in zip(marginal, rule.fold.tolist(), strict=True)
        ]
        # Of 20 pairs, 80 % of 21 are 16.8, so that the 17th counts.
        low = sorted(float(end[0]) for end in ends)[-17]
        high = sorted(float(end[1]) for end in ends)[16]
        assert float(found.low[number, parameter]) == pytest.approx(max(low, -1))
        assert float(found.high[number, parameter]) == pytest.approx(min(high, 1))


def test_a_set_says_what_it_promises(stack: StackedPosterior, x: Tensor) -> None:
    assert "no guarantee" in str(stack.credible_set(0.9, x, seed=0))
    for make in (stack.credible_set, stack.credible_intervals):
        assert "20 calibration pairs" in str(make(0.9, x, guaranteed=True, seed=0))


@pytest.mark.parametrize("name", ["credible_set", "credible_intervals"])
def test_a_level_that_draws_or_pairs_cannot_give_is_refused(
    stack: StackedPosterior, x: Tensor, name: str
) -> None:
    call, of_npe = getattr(stack, name), getattr(exact(), name)
    needed = 1000 if name == "credible_set" else 2000
    call(0.95, x, guaranteed=True, num_samples=10)
    of_npe(0.999, X, num_samples=needed)
    for refused, level, options, match in (
        (of_npe, 0.999, {"num_samples": needed - 1}, f"at least {needed} for a level"),
        (of_npe, 0.9, {"guaranteed": True}, r"stack\(rope\)"),
        (call, 0.99, {"guaranteed": True}, r"0\.952.*99"),
        (call, 0.4, {"guaranteed": True}, r"at least 0\.5"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            refused(level, X if refused is of_npe else x, **options)


def test_labels_that_the_stack_says_are_impossible_are_refused(
    stack: StackedPosterior, x: Tensor
) -> None:
    changed = pickle.loads(pickle.dumps(stack))
    known = stack.report
    joint = known.set_scores.joint.clone()

    def make(count: int) -> CredibleSet:
        joint[:count] = torch.inf
        scores = replace(known.set_scores, joint=joint)
        changed.report = StackingReport.of(replace(known, set_scores=scores))
        return changed.credible_set(0.9, x, guaranteed=True)

    assert math.isfinite(make(1).volume)
    with pytest.raises(InvalidInputError, match="2 of 20 without"):
        make(2)


def test_of_pairs_with_the_same_parameters_one_counts(x: Tensor) -> None:
    theta, x_cal = stacks.problem(12, seed=1)
    pairs = torch.cat([theta, theta[:8]]), torch.cat([x_cal, x_cal[:8] + 0.1])
    posterior = stacks.stacked(
        stacks.rope_of(pairs), candidates=[stacks.PRIOR, stacks.NPE]
    )
    scores = posterior.report.set_scores
    assert scores is not None
    assert len(scores) == 12
    counted = pairs[0][scores.is_counted]
    assert len(counted.unique(dim=0)) == 12
    found = posterior.credible_set(0.9, x, guaranteed=True, seed=0)
    assert found.guarantee is not None
    assert found.guarantee.num_pairs == 12
    with pytest.raises(InvalidInputError, match="12 exact labels"):
        posterior.credible_set(0.95, x, guaranteed=True)


@pytest.mark.medium
def test_sets_of_mixed_parameters_hold_categories_only() -> None:
    prior = problems.mixed_prior(2)
    theta = prior.sample((12,))
    pairs = theta, problems.simulate(theta)
    candidates = [stacks.PRIOR, stacks.NPE]
    rope = stacks.rope_of(pairs, family="mnpe")
    posterior = stacks.stacked(rope, candidates=candidates)
    found = posterior.credible_set(0.9, pairs[1][0], guaranteed=True, seed=0)
    assert math.isfinite(found.volume)
    members = found.draws[found.inside][:, 2:]
    assert len(members)
    assert torch.equal(members, members.round())
