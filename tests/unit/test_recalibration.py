"""Posteriors that are made narrower or wider, against closed forms."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import scipy.interpolate
import scipy.optimize
import scipy.stats
import torch
from sbi.utils import within_support
from torch import Tensor, nn
from torch.distributions import Exponential, Independent

from sbi_rope import MixturePosterior
from sbi_rope._bounds import Bounds, bounds_of_prior, to_line
from sbi_rope._means import Counts
from sbi_rope.errors import SamplingError, UnsupportedPosteriorError
from sbi_rope.mixture import MixtureEstimator, OwnEmbeddings, Part, average
from sbi_rope.recalibration import Recalibration
from sbi_rope.recalibration.estimator import RecalibratedEstimator
from sbi_rope.recalibration.factors import HeldOutGrid, HeldOutMixture
from sbi_rope.recalibration.recalibration import recalibrate
from sbi_rope.recalibration.spread import Spread
from sbi_rope.tasks.triangle import UniformTriangle
from tests import problems

INF = math.inf
FACTORS = torch.tensor([0.5, 1.5])
# One parameter without bounds, two with one bound, and one with both.
LOW = torch.tensor([-INF, 0.0, -INF, -2.0]).double()
HIGH = torch.tensor([INF, INF, 1.0, 3.0]).double()


def gaussians(
    dim: int = 2, *, factors: Tensor = FACTORS, bound: float = INF
) -> RecalibratedEstimator:
    """The posterior N(x_1, exp(x_2)^2) with other spreads."""
    part = Part(
        problems.Gaussians(dim), OwnEmbeddings([nn.Identity()], torch.Size((2 * dim,)))
    )
    bounds = torch.full((dim,), bound)
    return RecalibratedEstimator(
        MixtureEstimator([part], [1.0]), factors, Bounds(-bounds, bounds, are_all=True)
    )


def observations(n: int, *, dim: int = 2, std: float = 0.3) -> Tensor:
    """Observations whose posteriors have means in a box, and one deviation."""
    mean = 2 * torch.rand(n, dim) - 1
    return torch.cat([mean, torch.full((n, dim), math.log(std))], dim=1)


def folds_of(
    n: int, *, too_wide: Tensor, num_folds: int = 2, seed: int = 0
) -> list[HeldOutMixture]:
    """Pairs from posteriors that are narrower than those that are recalibrated."""
    torch.manual_seed(seed)
    x = observations(n, dim=len(too_wide))
    mean, log_std = x.chunk(2, dim=1)
    theta = mean + log_std.exp() / too_wide * torch.randn(mean.shape)
    estimator = gaussians(len(too_wide), factors=torch.ones(len(too_wide)))
    return [
        HeldOutMixture(estimator=estimator, theta=theta[rows], x=x[rows])
        for rows in torch.arange(n).chunk(num_folds)
    ]


def recalibration(folds: list[HeldOutMixture]) -> Recalibration:
    count = sum(len(fold.theta) for fold in folds)
    return recalibrate(folds, Counts(torch.ones(count).double()), seed=0)


def test_a_map_and_its_inverse_undo_each_other_and_stay_inside_the_bounds() -> None:
    theta = torch.tensor([[1000.0, 2.0, -5.0, 0.3], [-3.0, 1e-3, 0.9, 2.99]]).double()
    spread = Spread(
        torch.tensor([1.0, -1.0, 0.5, 0.2]).double(),
        torch.tensor([0.5, 2.0, 0.7, 1.3]).double(),
        LOW,
        HIGH,
    )
    moved = spread.forward(theta)
    assert ((moved > LOW) & (moved < HIGH)).all()
    torch.testing.assert_close(spread.inverse(moved)[0], theta)
    torch.testing.assert_close(moved[0, 0], torch.tensor(500.5).double())


def test_the_slope_of_the_inverse_is_that_of_automatic_differentiation() -> None:
    theta = torch.tensor([1000.0, 2.0, -5.0, 0.3]).double()
    spread = Spread(torch.zeros(4).double(), 0.5 + torch.rand(4).double(), LOW, HIGH)
    slopes = torch.autograd.functional.jacobian(lambda t: spread.inverse(t)[0], theta)
    _, slope = spread.inverse(theta)
    assert isinstance(slopes, Tensor)
    torch.testing.assert_close(slope, slopes.diagonal().log().sum())


def test_a_gaussian_stays_a_gaussian_with_another_deviation() -> None:
    torch.manual_seed(0)
    estimator, x = gaussians(), observations(3)
    mean, log_std = x.chunk(2, dim=1)
    std = log_std.exp() * FACTORS
    theta = mean + std * torch.randn(50, 3, 2)
    exact = torch.distributions.Normal(mean, std).log_prob(theta).sum(dim=2)
    # The centre is the mean of 256 draws, which is off by a sixteenth of a deviation.
    assert float((estimator.log_prob(theta, x) - exact).abs().max()) < 0.3
    assert float((estimator.log_prob(theta, x) - exact).mean().abs()) < 0.02
    draws = estimator.sample(torch.Size((20_000,)), x)
    torch.testing.assert_close(draws.std(dim=0), std, rtol=0.03, atol=0.0)


@pytest.mark.parametrize("factors", [(0.5, 0.5), (1.6, 0.8)])
def test_the_density_integrates_to_one_in_a_box_and_is_that_of_the_draws(
    factors: tuple[float, float],
) -> None:
    torch.manual_seed(0)
    estimator = gaussians(factors=torch.tensor(factors), bound=1.0)
    posterior = MixturePosterior(estimator, problems.box(2))
    x = observations(1, std=0.7)
    # Midpoints of 200 x 200 cells.
    middle = (torch.arange(200) + 0.5) / 100 - 1
    grid = torch.cartesian_prod(middle, middle)
    mass = posterior.log_prob(grid, x=x).double().exp().reshape(200, 200) / 100**2
    assert float(mass.sum()) == pytest.approx(1.0, abs=0.03)
    draws = posterior.sample((4000,), x=x)
    ends = torch.linspace(-1, 1, 201)
    for j in range(2):
        cdf = torch.cat([torch.zeros(1), mass.sum(dim=1 - j).cumsum(dim=0)])
        exact = scipy.interpolate.interp1d(ends.numpy(), (cdf / cdf[-1]).numpy())
        assert scipy.stats.kstest(draws[:, j].numpy(), exact).pvalue > 0.01
    outside = posterior.log_prob(torch.tensor([[1.1, 0.0]]), x=x)
    assert outside.item() == -INF


@pytest.mark.medium
def test_many_pairs_find_a_factor_for_each_parameter() -> None:
    found = recalibration(folds_of(1000, too_wide=torch.tensor([2.0, 0.8])))
    torch.testing.assert_close(
        found.factors, torch.tensor([0.5, 1.25]).double(), rtol=0.08, atol=0.0
    )
    # The mean gain in closed form, with posteriors too wide by w.
    gain = sum(math.log(w) - 0.5 + 0.5 / w**2 for w in (2.0, 0.8))
    assert found.interval[0] < gain < found.interval[1]
    assert found.before.verdict == "too wide"
    assert found.after.verdict == "calibrated"


class Correlated(problems.Gaussians):
    """Two parameters with a correlation of 0.9."""

    ROOT = torch.linalg.cholesky(torch.tensor([[1.0, 0.9], [0.9, 1.0]]))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        mean, log_std = condition.chunk(2, dim=-1)
        white = ((input - mean) / log_std.exp()) @ torch.linalg.inv(self.ROOT).T
        first = torch.cat([torch.zeros_like(mean), torch.zeros_like(log_std)], dim=-1)
        log_det = self.ROOT.diagonal().log().sum() + log_std.sum(-1)
        return super().log_prob(white, first) - log_det

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        mean, log_std = condition.chunk(2, dim=-1)
        noise = torch.randn(*sample_shape, *mean.shape).to(mean)
        return mean + log_std.exp() * (noise @ self.ROOT.T)


@pytest.mark.medium
def test_the_gain_is_that_of_the_density_with_all_factors_together() -> None:
    """The effects of single factors do not add up if parameters are correlated."""
    torch.manual_seed(0)
    x = observations(200)
    mean, log_std = x.chunk(2, dim=1)
    noise = torch.randn(mean.shape) @ Correlated.ROOT.T
    theta = mean + log_std.exp() * noise * torch.tensor([0.7, 1.4])
    part = Part(Correlated(2), OwnEmbeddings([nn.Identity()], torch.Size((4,))))
    bounds = Bounds(torch.full((2,), -INF), torch.full((2,), INF), are_all=True)
    estimator = RecalibratedEstimator(
        MixtureEstimator([part], [1.0]), torch.ones(2), bounds
    )
    # The same pairs in both folds, so that the factors of the others are those of all.
    fold = HeldOutMixture(estimator=estimator, theta=theta, x=x)
    found = recalibration([fold, fold])
    assert found.is_used
    assert not torch.equal(found.factors, torch.ones(2))
    changed = RecalibratedEstimator(
        MixtureEstimator([part], [1.0]), found.factors, bounds
    )
    expected = changed.log_prob(theta[None], x) - estimator.log_prob(theta[None], x)
    assert found.gain == pytest.approx(float(expected.mean()), abs=0.02)


def test_a_few_pairs_choose_what_the_prior_of_the_factors_says() -> None:
    folds = folds_of(8, too_wide=torch.tensor([2.0, 0.8]), seed=3)
    weights = torch.ones(8).double()
    found = HeldOutGrid.of(folds, weights).best(torch.ones(8).bool())
    z = torch.cat(
        [(fold.theta - fold.spread.centre) / fold.x[:, 2:].exp() for fold in folds]
    ).double()

    def loss(values: Any) -> float:
        common, own = values[0], torch.as_tensor(values[1:])
        log_s = common + own
        fit = (-0.5 * (z * (-log_s).exp()).square() - log_s).sum()
        prior = (common / 0.3) ** 2 / 2 + (own / 0.15).square().sum() / 2
        return float(prior - fit)

    exact = scipy.optimize.minimize(loss, [0.0, 0.0, 0.0]).x
    expected = torch.as_tensor(exact[0] + exact[1:]).exp()
    torch.testing.assert_close(found.factors, expected, rtol=0.1, atol=0.0)
    # The prior keeps them nearer to 1 than the pairs alone would.
    assert float(expected.log().abs().max()) < 0.8


@pytest.mark.slow
def test_a_calibrated_posterior_is_left_as_it_is_or_hardly_changed() -> None:
    gains = []
    for seed in range(20):
        folds = folds_of(40, too_wide=torch.ones(2), num_folds=5, seed=seed)
        found = recalibration(folds)
        low, high = found.interval
        error = 0.5 * (high - low) / float(scipy.stats.t.ppf(0.975, 39))
        assert found.is_used == (found.gain > error)
        assert float(found.factors.log().abs().max()) < 0.4
        gains.append(found.gain)
    # What two numbers that are fitted to 32 pairs cost.
    assert -0.08 < sum(gains) / 20 < 0.02


def test_pairs_with_the_same_parameters_do_not_make_it_more_certain() -> None:
    folds = folds_of(30, too_wide=torch.tensor([1.3, 1.3]), num_folds=3)
    once = recalibration(folds)
    repeated = [
        replace(fold, theta=fold.theta.repeat(4, 1), x=fold.x.repeat(4, 1))
        for fold in folds
    ]
    groups = torch.cat([part.repeat(4) for part in torch.arange(30).chunk(3)])
    counts = Counts(torch.full((120,), 0.25).double(), groups)
    found = recalibrate(repeated, counts, seed=0)
    torch.testing.assert_close(found.factors, once.factors, rtol=0.06, atol=0.0)
    assert found.gain == pytest.approx(once.gain, abs=0.02)
    assert found.interval == pytest.approx(once.interval, abs=0.05)
    assert found.before.interval == pytest.approx(once.before.interval, abs=0.03)


def test_parameters_on_a_bound_have_a_density_that_is_neither_zero_nor_infinite() -> (
    None
):
    low, high = torch.tensor([5.0, 0.0]).double(), torch.tensor([7.0, 1.0]).double()
    edges = torch.stack([low, high])
    assert float(to_line(edges, low, high).abs().max()) < 17
    bounds = Bounds(low, high, are_all=True)
    assert bounds.hold(edges).tolist() == [False, False]
    assert bounds.hold((low + high)[None] / 2).tolist() == [True]
    half = Bounds(low, torch.full_like(high, INF), are_all=True)
    assert half.hold(torch.stack([low, low + 1e-9])).tolist() == [False, True]


def test_a_recalibrated_mixture_is_no_part_of_another() -> None:
    estimator = gaussians(factors=torch.tensor([0.5, 0.5]), bound=1.0)
    posterior = MixturePosterior(estimator, problems.box(2))
    with pytest.raises(UnsupportedPosteriorError, match="its factors would be lost"):
        average([posterior, posterior])


def test_factors_that_lower_the_score_are_not_used() -> None:
    # The pairs of each fold ask for the opposite of what the others ask for.
    folds = []
    for k, too_wide in enumerate((0.5, 2.0)):
        folds += folds_of(100, too_wide=torch.full((2,), too_wide), num_folds=1, seed=k)
    found = recalibration(folds)
    assert found.interval[1] < 0
    assert not found.is_used
    assert torch.equal(found.factors, torch.ones(2).double())
    assert "was not used: its gain, -" in str(found)


def test_a_pair_with_a_density_of_zero_says_nothing_about_the_spread() -> None:
    folds = folds_of(40, too_wide=torch.tensor([2.0, 2.0]), num_folds=5)
    expected = recalibration(folds)
    far = folds[0].theta.clone()
    far[0] = 1e30  # the density underflows
    folds[0] = replace(folds[0], theta=far)
    found = recalibration(folds)
    assert math.isfinite(found.gain)
    torch.testing.assert_close(found.factors, expected.factors, rtol=0.11, atol=0.0)


def test_the_bounds_of_a_prior_are_found_and_whether_they_are_all() -> None:
    found = bounds_of_prior(problems.box(2))
    assert torch.equal(found.low, -torch.ones(2).double())
    assert torch.equal(found.high, torch.ones(2).double())
    assert found.are_all
    found = bounds_of_prior(Independent(Exponential(torch.ones(2)), 1))
    assert torch.equal(found.low, torch.zeros(2).double())
    assert torch.isinf(found.high).all()
    assert found.are_all
    assert bounds_of_prior(problems.standard_normal(2)).are_all
    assert not bounds_of_prior(UniformTriangle(torch.tensor(1.0))).are_all


@pytest.mark.parametrize("factors", [(0.6, 0.6), (1.5, 1.5)])
def test_in_a_triangle_the_density_has_mass_one_and_is_that_of_the_draws(
    factors: tuple[float, float],
) -> None:
    torch.manual_seed(1)
    triangle = UniformTriangle(torch.tensor(1.0))
    estimator = RecalibratedEstimator(
        gaussians(), torch.tensor(factors), bounds_of_prior(triangle)
    )
    posterior = MixturePosterior(estimator, triangle)
    x = torch.tensor([[0.6, 0.4, math.log(0.2), math.log(0.2)]])
    middle = (torch.arange(300) + 0.5) / 300
    grid = torch.cartesian_prod(middle, middle)
    mass = posterior.log_prob(grid, x=x).double().exp().reshape(300, 300) / 300**2
    assert float(mass.sum()) == pytest.approx(1.0, abs=0.04)
    draws = posterior.sample((4000,), x=x)
    assert (draws[:, 0] >= draws[:, 1]).all()
    ends = torch.linspace(0, 1, 301)
    for j in range(2):
        cdf = torch.cat([torch.zeros(1), mass.sum(dim=1 - j).cumsum(dim=0)])
        exact = scipy.interpolate.interp1d(ends.numpy(), (cdf / cdf[-1]).numpy())
        assert scipy.stats.kstest(draws[:, j].numpy(), exact).pvalue > 0.01
    # In the other order of dimensions, and for several observations.
    both = posterior.sample_batched((20,), torch.cat([x, x]), show_progress_bars=False)
    assert both.shape == (20, 2, 2)
    assert (both[..., 0] >= both[..., 1]).all()


def test_rare_draws_in_a_triangle_are_found_in_the_time_that_they_are_given() -> None:
    triangle = UniformTriangle(torch.tensor(1.0))
    estimator = RecalibratedEstimator(
        gaussians(), torch.full((2,), 1.1), bounds_of_prior(triangle)
    )
    posterior = MixturePosterior(estimator, triangle)
    x = torch.tensor([[0.4, 0.6], [0.6, 0.4], [0.2, 0.8]])
    x = torch.cat([x, torch.full((3, 2), math.log(0.07))], dim=1)
    mass = posterior.leakage(x).mass
    assert float(mass[0]) < 0.05
    assert float(mass[1]) > 0.9
    draws = posterior.sample_batched((3000,), x[:2], show_progress_bars=False)
    assert (draws[..., 0] >= draws[..., 1]).all()
    # Where hardly any are inside, those that are lie near the edge.
    assert float((draws[:, 0, 0] - draws[:, 0, 1]).mean()) < 0.1
    sample = partial(posterior.sample, (3000,), show_progress_bars=False)
    with pytest.raises(SamplingError, match="`max_sampling_time`"):
        sample(x=x[:1], max_sampling_time=1e-9)
    with pytest.raises(SamplingError, match="Less than one in 1000 draws of the recal"):
        sample(x=x[2:])


@pytest.mark.medium
def test_what_is_moved_out_of_a_triangle_counts_when_factors_are_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Fewer draws make the factors less precise than the pairs leave them anyway.
    monkeypatch.setattr("sbi_rope.recalibration.factors.NUM_DRAWS", 150)
    torch.manual_seed(0)
    triangle = UniformTriangle(torch.tensor(1.0))
    x = torch.cat([triangle.sample((100,)), torch.full((100, 2), math.log(0.3))], dim=1)
    estimator = RecalibratedEstimator(
        gaussians(), torch.ones(2), bounds_of_prior(triangle)
    )
    # The parameters are draws of the posterior, which is cut off by the triangle.
    theta = MixturePosterior(estimator, triangle).sample_batched((1,), x)[0]
    folds = [
        HeldOutMixture(
            estimator=estimator,
            theta=theta[rows],
            x=x[rows],
            accept=partial(within_support, triangle),
        )
        for rows in torch.arange(100).chunk(4)
    ]
    found = recalibration(folds)
    assert float(found.factors.log().abs().max()) < 0.16
    assert found.before.verdict == "calibrated"
    # What is drawn follows from the seed, and leaves the caller's state alone.
    torch.manual_seed(1)
    state = torch.get_rng_state()
    again = recalibration([replace(fold) for fold in folds])
    assert torch.equal(torch.get_rng_state(), state)
    assert again.gain == found.gain
