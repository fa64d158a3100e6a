"""Coverage by estimate, against uniform ranks, closed forms and counting."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.stats import binom, kstest
from torch import Tensor
from torch.distributions import Normal

from sbi_rope import plots
from sbi_rope.data import Counts
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics import CoverageByEstimate, coverage_by_estimate, evaluate
from sbi_rope.metrics.by_estimate import (
    estimates_and_ranks,
    in_words,
)
from tests import gaussian
from tests.refusals import assert_refused


def estimated(n: int = 300, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Parameters of a linear-Gaussian problem, and their exact posterior means."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(n, 1, generator=generator)
    noise = gaussian.NOISE_STD * torch.randn(n, 1, generator=generator)
    return theta, gaussian.GAIN * (theta + noise)


def ranks_in(theta: Tensor, mean: Tensor, std: Tensor | float) -> Tensor:
    """The exact ranks of parameters in normal posteriors."""
    return Normal(mean, torch.as_tensor(std)).cdf(theta)


@pytest.mark.medium
def test_p_values_of_calibrated_posteriors_are_uniform() -> None:
    """This holds for estimates of any distribution, and with few observations."""
    generator = torch.Generator().manual_seed(0)
    found = coverage_by_estimate(
        torch.rand(15, 100, generator=generator),
        torch.randn(15, 100, generator=generator).exp(),
    )
    assert kstest(found.p_values, "uniform").pvalue > 0.01


def held_out_p_value(n: int, seed: int) -> float:
    """The p-value of the held-out posteriors of a Bayesian linear regression of x.

    The pairs have x = 0.7 + 1.4 theta + noise. The posterior of theta given x is exact
    on a grid, with the coefficients integrated out given the pairs of other folds.
    """
    generator = torch.Generator().manual_seed(seed)
    theta, noise = torch.randn(2, n, generator=generator, dtype=torch.double)
    x = 0.7 + 1.4 * theta + 0.7 * noise
    grid = torch.linspace(-5, 5, 1001, dtype=torch.double)
    on_grid, design = (torch.stack([t**0, t], dim=1) for t in (grid, theta))
    eye = torch.eye(2, dtype=torch.double)
    ranks, means = torch.empty(2, n, dtype=torch.double)
    for fold in range(5):
        held_out = torch.arange(n) % 5 == fold
        known, of_known = design[~held_out], x[~held_out]
        covariance = torch.linalg.inv(known.T @ known / 0.49 + 0.01 * eye)
        mean = on_grid @ covariance @ known.T @ of_known / 0.49
        variance = 0.49 + ((on_grid @ covariance) * on_grid).sum(dim=1)
        log_p = Normal(mean, variance.sqrt()).log_prob(x[held_out, None])
        share = (log_p - grid.square() / 2).softmax(dim=1)
        means[held_out] = share @ grid
        below = (grid <= theta[held_out, None]).double()
        ranks[held_out] = (share * below).sum(dim=1)
    return coverage_by_estimate(ranks[:, None], means[:, None]).p_values[0]


@pytest.mark.medium
@pytest.mark.parametrize("n", [15, pytest.param(60, marks=pytest.mark.slow)])
def test_held_out_posteriors_of_one_set_of_pairs_give_no_more_alarms(n: int) -> None:
    """Folds share most of their pairs, so that their errors are alike."""
    p_values = torch.tensor([held_out_p_value(n, seed) for seed in range(100)])
    # A number of alarms that is exceeded with a probability of one per cent.
    assert int((p_values < 0.05).sum()) <= binom.ppf(0.99, 100, 0.05)


@pytest.mark.parametrize("error", ["slope", "curve", "width in the tail", "width"])
def test_errors_that_depend_on_the_estimate_are_found(error: str) -> None:
    theta, mean = estimated()
    std: Tensor | float = gaussian.POSTERIOR_STD
    if error == "slope":
        mean = 1.3 * mean
    elif error == "curve":
        mean = mean + 0.2 * (mean.square() - mean.square().mean())
    elif error == "width in the tail":
        std = torch.where(mean.abs() > mean.std(), 0.5 * std, std)
    else:
        std = std * (0.5 * mean).exp()
    assert all(coverage_by_estimate(ranks_in(theta, mean, std), mean).depends)


@pytest.mark.medium
@pytest.mark.parametrize(("shift", "factor"), [(0.0, 1.0), (0.3, 1.0), (0.0, 0.5)])
def test_errors_that_are_the_same_everywhere_are_not_reported(
    shift: float, factor: float
) -> None:
    p_values = []
    for seed in range(25):
        theta, mean = estimated(60, seed)
        ranks = ranks_in(theta, mean + shift, factor * gaussian.POSTERIOR_STD)
        p_values.append(coverage_by_estimate(ranks, mean).p_values[0])
    assert kstest(p_values, "uniform").pvalue > 0.01


def test_shares_are_those_of_each_third() -> None:
    generator = torch.Generator().manual_seed(1)
    estimates = torch.randn(90, 2, generator=generator)
    ranks = torch.rand(90, 2, generator=generator)
    found = coverage_by_estimate(ranks, estimates, level=0.5)
    for k in range(2):
        order = estimates[:, k].argsort()
        for number, rows in enumerate(order.split(30)):
            inside = ((ranks[rows, k] >= 0.25) & (ranks[rows, k] <= 0.75)).double()
            assert found.shares[k, number] == inside.mean()
            above = (ranks[rows, k] > 0.5).double().mean()
            assert found.above[k, number] == above
            assert ((estimates[rows, k] > found.edges[k, 0]) == (number > 0)).all()
            assert ((estimates[rows, k] < found.edges[k, 1]) == (number < 2)).all()


def test_thirds_are_filled_if_estimates_are_equal() -> None:
    ranks = torch.rand(30, 1, generator=torch.Generator().manual_seed(5))
    found = coverage_by_estimate(ranks, torch.ones(30, 1))
    assert found.p_values == (1.0,)
    inside = ((ranks - 0.5).abs() <= 0.45).double().reshape(3, 10).mean(dim=1)
    assert torch.equal(found.shares[0], inside)


def test_parameters_that_are_not_known_are_left_out() -> None:
    theta, mean = estimated()
    ranks = ranks_in(theta, 1.3 * mean, gaussian.POSTERIOR_STD)
    alone = coverage_by_estimate(ranks[::2], mean[::2])
    gaps = ranks.clone()
    gaps[1::2] = torch.nan
    found = coverage_by_estimate(gaps, mean)
    assert found.p_values == alone.p_values
    assert torch.equal(found.shares, alone.shares)
    beside = coverage_by_estimate(
        torch.cat([ranks, torch.full_like(ranks, torch.nan)], dim=1),
        torch.cat([mean, mean], dim=1),
    )
    assert beside.num_tested == 1
    assert beside.depends == (True, False)
    assert beside.shares[1].isnan().all()


def test_a_p_value_counts_less_among_those_of_many_parameters() -> None:
    found = replace(found_somewhere(), p_values=(0.03,))
    assert found.depends == (True,)
    assert not any(replace(found, p_values=(0.03, 0.5)).depends)
    assert replace(found, p_values=(0.03, math.nan)).depends == (True, False)


def test_too_few_observations_are_not_tested() -> None:
    few = coverage_by_estimate(torch.rand(9, 2), torch.rand(9, 2))
    assert few.num_tested == 0
    assert not any(few.depends)
    assert in_words(few, ("a", "b")) == []
    assert str(few) == "not tested, with fewer than 10 independent observations"


def test_only_one_pair_of_a_group_is_tested_and_groups_count_once() -> None:
    theta, mean = estimated()
    ranks = ranks_in(theta, mean, gaussian.POSTERIOR_STD)
    rows = torch.arange(300)
    found = coverage_by_estimate(
        torch.cat([ranks, ranks]),
        torch.cat([mean, mean]),
        Counts(torch.full((600,), 0.5), torch.cat([rows, rows])),
        chosen=torch.cat([rows >= 0, rows < 0]),
    )
    once = coverage_by_estimate(ranks, mean)
    assert found.p_values == once.p_values
    assert torch.allclose(found.shares, once.shares)


def test_means_and_ranks_come_from_different_samples() -> None:
    """Of the same samples, those too high by chance raise the mean, lower the rank."""
    generator = torch.Generator().manual_seed(2)
    samples = torch.randn(10, 5000, 1, generator=generator)
    theta = torch.randn(5000, 1, generator=generator)
    estimates, ranks = estimates_and_ranks(samples, theta)
    both = torch.cat([estimates, ranks], dim=1)
    assert abs(float(both.T.corrcoef()[0, 1])) < 3 / 5000**0.5
    assert not any(coverage_by_estimate(ranks, estimates).depends)


def test_an_evaluation_says_where_coverage_is_off() -> None:
    torch.manual_seed(3)
    theta = gaussian.prior().sample((300,))
    x = gaussian.simulator(theta)
    right = evaluate(gaussian.posterior(), theta, x, num_samples=100, seed=0)
    assert not any(right.by_estimate.depends)
    assert "no sign that coverage depends on the estimate" in str(right)
    # With too large a gain, the posterior overestimates what is large.
    posterior = gaussian.posterior()
    wrong = evaluate(posterior, theta, 1.4 * x, num_samples=100, seed=0)
    assert all(wrong.by_estimate.depends)
    assert "the coverage of theta_1 depends on its estimate (p = 0.001)" in str(wrong)
    posterior.parameter_names = ("mass", "length")  # as stacks have
    named = str(evaluate(posterior, theta, 1.4 * x, num_samples=100, seed=0))
    assert "coverage of mass depends" in named
    assert "coverage of length depends" in named
    low, middle, high = wrong.by_estimate.shares[0].tolist()
    assert max(low, high) < middle
    text = " ".join(str(wrong).split())
    assert f"90% intervals hold {low:.0%}, {middle:.0%} and {high:.0%} of" in text
    # Posteriors of what is low are too low, so that the truth is above their median.
    assert wrong.by_estimate.above[0, 0] > 0.7
    assert wrong.by_estimate.above[0, 2] < 0.3


def found_somewhere() -> CoverageByEstimate:
    theta, mean = estimated()
    return coverage_by_estimate(
        ranks_in(theta, 1.3 * mean, gaussian.POSTERIOR_STD), mean
    )


def test_the_picture_has_a_panel_for_each_of_six_parameters() -> None:
    one = found_somewhere()
    many = coverage_by_estimate(one.ranks.repeat(1, 8), one.estimates.repeat(1, 8))
    figure = plots.ranks_by_estimate(many)
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == [f"estimate of theta_{k}" for k in range(1, 7)]
    named = plots.ranks_by_estimate(one, parameter_names=("slope",))
    (axes,) = named.axes
    assert axes.get_xlabel() == "estimate of slope"
    shown = [text.get_text() for text in axes.texts]
    assert shown == [f"{share:.0%}" for share in one.shares[0].tolist()]


def test_bad_arguments_are_refused() -> None:
    ranks, estimates = torch.rand(20, 2), torch.rand(20, 2)
    gap = estimates.where(torch.arange(2) == 0, torch.nan)
    assert_refused("level", coverage_by_estimate, ranks, estimates, level=1.0)
    assert_refused("estimates", coverage_by_estimate, ranks, gap)
    assert_refused("estimates", coverage_by_estimate, ranks[:, :1], estimates)
    assert_refused("estimates", coverage_by_estimate, ranks[:10], estimates)
    assert_refused("ranks", coverage_by_estimate, ranks + 1, estimates)
    assert_refused(
        "ranks", coverage_by_estimate, "ranks", estimates, error=InvalidInputError
    )
    draw = plots.ranks_by_estimate
    assert_refused("found", draw, ranks, error=InvalidInputError)
    names = ("a", "b")
    assert_refused("parameter_names", draw, found_somewhere(), parameter_names=names)
