"""Scores agree with closed forms and are careful with posteriors that misbehave."""

import math
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior
from sbi.inference.posteriors import EnsemblePosterior
from sbi.utils import BoxUniform
from scipy.stats import kstest
from torch import Tensor
from torch.distributions import Normal

from sbi_rope import metrics
from sbi_rope.metrics import Estimate, Evaluation
from sbi_rope.metrics.evaluation import NOMINAL, estimates_and_ranks
from sbi_rope.utils.errors import InvalidInputError
from tests import gaussian

NORMAL = Normal(torch.tensor(0.0, dtype=torch.float64), 1.0)
torch.manual_seed(0)
VALUES = torch.randn(12, dtype=torch.double)
RANKS = torch.rand(12, 2, dtype=torch.double)
GROUP = torch.arange(12).repeat_interleave(4)


class GaussianPosterior:
    """N(x + bias, scale^2) in every dimension, in sbi's shapes."""

    def __init__(self, bias: float = 0.0, scale: float = 1.0) -> None:
        self.bias, self.scale = bias, scale

    def sample_batched(self, sample_shape: Any, x: Tensor, **options: Any) -> Tensor:
        return Normal(x + self.bias, self.scale).sample(sample_shape)

    def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
        return Normal(x + self.bias, self.scale).log_prob(theta[None]).sum(dim=-1)


def gaussian_pairs(n: int, d: int = 1) -> tuple[Tensor, Tensor]:
    """Theta given x is N(x, 1)."""
    x = 3.0 * torch.randn(n, d)
    return x + torch.randn(n, d), x


def scored(
    ranks: Tensor, estimates: Tensor | None = None, **options: Any
) -> Evaluation:
    """Scores of ranks of which nothing else is known."""
    log_prob = torch.zeros(len(ranks), dtype=torch.double)
    estimates = torch.zeros_like(ranks) if estimates is None else estimates
    return Evaluation(log_prob=log_prob, ranks=ranks, estimates=estimates, **options)


def half(found: Estimate) -> float:
    return (found.high - found.low) / 2


def test_an_interval_holds_the_mean_as_often_if_one_pair_counts_as_all_others() -> None:
    generator = torch.Generator().manual_seed(0)
    weight, held = torch.tensor([29.0] + [1.0] * 29).double(), 0
    for _ in range(400):
        values = torch.randn(30, generator=generator, dtype=torch.double)
        found = Estimate.of(values, weight)
        held += found.low < 0 < found.high
    # In many more draws it is 98 %; as if 30 pairs counted the same, it is 68 %.
    assert held > 0.93 * 400


def test_an_infinite_value_leaves_no_ends_and_a_single_one_no_interval() -> None:
    values = torch.cat([VALUES, torch.tensor([-math.inf]).double()])
    found = Estimate.of(values, torch.ones(13), torch.arange(13))
    assert (found.mean, found.low, found.high) == (-math.inf, -math.inf, math.inf)
    assert math.isnan(Estimate.of(VALUES[:1]).low)


def test_repeated_pairs_of_a_group_give_the_scores_of_single_ones() -> None:
    weight = torch.full((48,), 0.25).double()
    repeated = scored(RANKS.repeat_interleave(4, dim=0), weight=weight, group=GROUP)
    once = scored(RANKS)
    assert repeated.num_independent == pytest.approx(12)
    for mine, other in (
        (repeated.mean(VALUES.repeat_interleave(4)), once.mean(VALUES)),
        (repeated.acauc, once.acauc),
        *zip(repeated.acauc_of_parameters, once.acauc_of_parameters, strict=True),
    ):
        assert vars(mine) == pytest.approx(vars(other))
    torch.testing.assert_close(repeated.coverage, once.coverage)


def test_a_weight_counts_as_so_many_pairs_and_nan_is_left_out() -> None:
    times = torch.tensor([1, 2, 3] * 4)
    ranks = RANKS.clone()
    ranks[2, 0] = math.nan  # a parameter that was not measured
    found = scored(ranks, weight=times.double())
    several = scored(ranks.repeat_interleave(times, dim=0))
    assert found.acauc.mean == pytest.approx(several.acauc.mean)
    for k, column in enumerate(several.ranks.T):
        known = scored(column[~column.isnan(), None])
        torch.testing.assert_close(found.coverage[:, k], known.coverage[:, 0])


@pytest.mark.parametrize("chance", [0.5, 0.95])
def test_ranks_of_a_discrete_parameter_are_uniform(chance: float) -> None:
    torch.manual_seed(0)
    draws = torch.bernoulli(torch.full((201, 500, 1), chance))
    ranks = estimates_and_ranks(draws[1:], draws[0])[1]
    assert kstest(ranks[:, 0], "uniform").pvalue > 0.01


def test_means_and_ranks_come_from_different_samples() -> None:
    generator = torch.Generator().manual_seed(2)
    samples = torch.randn(10, 5000, 1, generator=generator)
    theta = torch.randn(5000, 1, generator=generator)
    estimates, ranks = estimates_and_ranks(samples, theta)
    both = torch.cat([estimates, ranks], dim=1)
    assert abs(float(both.T.corrcoef()[0, 1])) < 3 / 5000**0.5


def test_coverage_counts_a_level_that_is_equal_to_the_nominal_one() -> None:
    found = scored(torch.tensor([[0.785], [0.5]], dtype=torch.double))
    assert NOMINAL[56] == pytest.approx(0.57)
    assert found.coverage[[0, 55, 56, 98], 0].tolist() == [0.5, 0.5, 1.0, 1.0]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "d", "copies"), [(10, 1, 1), (10, 3, 1), (10, 1, 3)])
def test_calibrated_ranks_of_ten_seldom_have_an_interval_without_zero(
    n: int, d: int, copies: int
) -> None:
    generator = torch.Generator().manual_seed(1)
    wrong = 0
    for _ in range(1000):
        levels = torch.rand(n, d, generator=generator).repeat(1, copies)
        found = scored((1 + levels) / 2).acauc
        wrong += found.low > 0 or found.high < 0
    # In many more draws it is 4 to 5 %; with two standard errors it would be 8 %.
    assert 0.02 < wrong / 1000 < 0.06


def expected_acauc(bias: float, scale: float, *, num_ranks: int) -> float:
    """Integrate the mean level, folded normal for many samples, over the truth."""
    z = torch.linspace(-9, 9, 20001, dtype=torch.float64)
    rank = NORMAL.cdf((z - bias) / scale)
    level = (2 * rank - 1).abs()
    spread = 2 * (rank * (1 - rank) / num_ranks).sqrt().clamp(min=1e-12)
    fold = (2 / math.pi) ** 0.5 * spread * torch.exp(-0.5 * (level / spread) ** 2)
    level = fold + level * torch.erf(level / spread / 2**0.5)
    return float(torch.trapezoid(level * NORMAL.log_prob(z).exp(), z)) - 0.5


@pytest.mark.medium
def test_acauc_of_gaussian_posteriors_has_its_exact_and_its_published_value() -> None:
    torch.manual_seed(0)
    theta, x = gaussian_pairs(1500)
    for bias, scale, published in (
        (0.0, 1.0, 0.0015),  # calibrated
        (0.0, 0.3, 0.3127),  # over-confident
        (0.0, 3.0, -0.298),  # under-confident
        (2.0, 1.0, 0.356),  # too high
    ):
        posterior = GaussianPosterior(bias, scale)
        found = metrics.evaluate(posterior, theta, x, num_samples=1250).acauc
        exact = expected_acauc(bias, scale, num_ranks=1000)
        # 0.001: finitely many samples; 0.002: the error of the published value.
        assert abs(found.mean - exact) < 2 * half(found) + 0.001
        assert abs(found.mean - published) < 2 * half(found) + 0.002


def test_coverage_of_gaussian_posteriors_follows_its_formula() -> None:
    torch.manual_seed(0)
    theta, x = gaussian_pairs(2000, d=2)
    found = metrics.evaluate(GaussianPosterior(scale=0.5), theta, x)
    expected = 2 * NORMAL.cdf(0.5 * NORMAL.icdf((1 + NOMINAL) / 2)) - 1
    # Four standard errors of a share, and a step of the ranks.
    error = 4 * (expected * (1 - expected) / 2000).sqrt() + 0.004
    assert ((found.coverage - expected[:, None]).abs() < error[:, None]).all()


def test_lpp_of_a_gaussian_matches_its_closed_form_in_any_unit() -> None:
    torch.manual_seed(0)
    theta, x = gaussian_pairs(4000, d=2)
    std = torch.tensor([3.0, 0.25])
    found = metrics.evaluate(GaussianPosterior(0.5, 2.0), theta, x, theta_std=std)
    # -log s - log(2 pi)/2 - (1 + b^2) / (2 s^2), and the variance of the last term.
    expected = 2 * (-math.log(2.0) - 0.5 * math.log(2 * math.pi) - 1.25 / 8)
    variance = 2 * (2 + 4 * 0.25) / (4 * 2.0**4)
    assert half(found.lpp) == pytest.approx(1.96 * (variance / 4000) ** 0.5, rel=0.1)
    assert abs(found.lpp.mean - expected) < 2 * half(found.lpp)
    # The same Gaussian, written in z = theta / s.
    scaled = Normal((x + 0.5) / std, 2.0 / std).log_prob(theta / std).sum(1)
    assert found.lpp_z.mean == pytest.approx(float(scaled.mean()), abs=1e-4)


def estimated() -> tuple[Tensor, Tensor]:
    """Parameters of a linear-Gaussian problem, and their exact posterior means."""
    theta, noise = torch.randn(2, 300, 1, generator=torch.Generator().manual_seed(0))
    return theta, gaussian.GAIN * (theta + gaussian.NOISE_STD * noise)


def ranks_in(theta: Tensor, mean: Tensor, std: Tensor | float) -> Tensor:
    """The exact ranks of parameters in normal posteriors."""
    return Normal(mean, torch.as_tensor(std)).cdf(theta)


@pytest.mark.medium
def test_p_values_of_calibrated_posteriors_are_uniform() -> None:
    generator = torch.Generator().manual_seed(0)
    ranks = torch.rand(15, 100, generator=generator)
    found = scored(ranks, torch.randn(15, 100, generator=generator).exp())
    assert kstest(found.dependence, "uniform").pvalue > 0.01


@pytest.mark.parametrize(
    ("mean_of", "std_of"),
    [
        (lambda mean: 1.3 * mean, torch.ones_like),
        (lambda mean: mean + 0.2 * (mean.square() - 0.8), torch.ones_like),
        (lambda mean: mean, lambda mean: (0.5 * mean).exp()),
        (lambda mean: mean, lambda mean: 1.0 - 0.5 * (mean.abs() > mean.std())),
    ],
    ids=["slope", "curve", "width", "width in the tail"],
)
def test_errors_that_depend_on_the_estimate_are_found(
    mean_of: Any, std_of: Any
) -> None:
    theta, mean = estimated()
    ranks = ranks_in(theta, mean_of(mean), gaussian.POSTERIOR_STD * std_of(mean))
    assert scored(ranks, mean_of(mean)).dependence[0] < 0.05


def test_coverage_is_said_for_each_third_of_the_estimates() -> None:
    estimates = torch.arange(90.0).flip(0)[:, None]
    # Of each third other shares are inside and above the median.
    ranks = torch.tensor([0.3] * 30 + [0.99] * 15 + [0.6] * 15 + [0.01] * 30)[:, None]
    unknown = torch.full_like(ranks, torch.nan)
    found = scored(torch.cat([ranks, unknown], 1), estimates.expand(90, 2))
    text = " ".join(str(found).split())
    assert "The coverage of theta_1 depends on its estimate (p = 0.001)" in text
    assert "90% intervals hold 0%, 50% and 100% of the true parameters" in text
    assert "and 0%, 100% and 0% are above the median" in text
    assert "theta_2 was not measured" in text
    assert "coverage of theta_2" not in text
    assert math.isnan(found.dependence[1])


def test_one_pair_of_each_group_is_tested() -> None:
    theta, mean = estimated()
    ranks = ranks_in(theta, 1.02 * mean, gaussian.POSTERIOR_STD).repeat(20, 1)
    mean, group = mean.repeat(20, 1), torch.arange(300).repeat(20)
    # All rows would make an error significant that so few do not show.
    assert scored(ranks, mean).dependence[0] < 0.01
    assert scored(ranks, mean, group=group).dependence[0] > 0.01


def test_an_evaluation_says_what_was_found() -> None:
    torch.manual_seed(3)
    posterior, theta = gaussian.posterior(), gaussian.prior().sample((300,))
    x = gaussian.simulator(theta)
    right = metrics.evaluate(posterior, theta, x, num_samples=200, seed=0)
    for text in (
        "Calibrated as far as 300 observations can tell",
        "No sign that coverage depends on the estimate",
        f"{right.lpp:.2f}",
        f"{right.lpp_z:.2f}",
    ):
        assert text in str(right)
    # With too large a gain, the posterior overestimates what is large.
    posterior.parameter_names = ("mass", "length")  # as stacks have
    wrong = metrics.evaluate(posterior, theta, 1.4 * x, num_samples=200, seed=0)
    assert "The posterior is over-confident: ACAUC +" in str(wrong)
    assert "mass alone is over-confident" in str(wrong)
    assert f"90% intervals {wrong.coverage[89].mean():.0%}" in str(wrong)
    assert "Too few known parameters" in str(scored(RANKS[:4]))
    narrow = (1 + torch.linspace(0, 1, 60).square()) / 2
    assert "The posterior is too wide: ACAUC -" in str(scored(narrow[:, None]))


def test_a_seed_fixes_the_samples_and_leaves_the_global_random_state_alone() -> None:
    theta, x = (one.repeat(2, 1) for one in gaussian_pairs(100))
    found = []
    for seed in (1, 1, 2):
        state = torch.get_rng_state()
        found.append(metrics.evaluate(GaussianPosterior(), theta, x, seed=seed))
        assert torch.equal(torch.get_rng_state(), state)
        torch.randn(7)
    ranks, again, other = (one.ranks for one in found)
    assert torch.equal(ranks, again)
    assert not torch.equal(ranks, other)
    # Equal observations in another chunk have other samples.
    assert not torch.equal(ranks[:100], ranks[100:])


def far_posterior() -> Any:
    """An NPE whose prior is far from all that it draws."""
    far = BoxUniform(torch.full((2,), 100.0), torch.full((2,), 101.0))
    return DirectPosterior(gaussian.GaussianEstimator(), far)


X_O = torch.tensor([[0.5, -1.0], [2.0, 0.0]])


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_samples_are_drawn_where_the_rejection_of_sbi_would_not_end() -> None:
    posterior, std = far_posterior(), gaussian.POSTERIOR_STD
    for one in (posterior, EnsemblePosterior([posterior, posterior])):
        samples = metrics.draw_samples(one, X_O, num_samples=4000)
        error = 5 * std / 4000**0.5
        assert torch.allclose(samples.mean(dim=0), gaussian.GAIN * X_O, atol=error)
        assert torch.allclose(samples.std(dim=0), torch.tensor(std), rtol=0.1)


def test_log_probs_of_an_npe_are_those_of_its_network_inside_the_prior() -> None:
    posterior, theta = far_posterior(), torch.full((2, 2), 100.5)
    found = metrics.evaluate(posterior, theta, X_O, num_samples=50)
    moved = metrics.evaluate(posterior, theta + 5, X_O, num_samples=50)
    raw = posterior.posterior_estimator.log_prob(theta, X_O)
    assert torch.allclose(found.log_prob, raw.detach().double(), rtol=1e-5)
    assert moved.log_prob.isneginf().all()
    assert "100.0% of the true parameters have density zero" in str(moved)


@pytest.mark.parametrize(
    ("method", "spoil", "match"),
    [
        ("log_prob_batched", lambda p: p * math.nan, "NaN or .Inf in 120 of 120 rows"),
        ("log_prob_batched", lambda p: p + math.inf, "NaN or .Inf in 120 of 120 rows"),
        ("sample_batched", lambda samples: samples * math.nan, "NaN"),
        ("sample_batched", lambda samples: samples.repeat(1, 1, 2), r"\(20, 100, 2\)"),
    ],
)
def test_a_posterior_that_returns_nan_or_a_wrong_shape_is_refused(
    method: str, spoil: Any, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    posterior = GaussianPosterior()
    right = getattr(posterior, method)
    monkeypatch.setattr(posterior, method, lambda *a, **b: spoil(right(*a, **b)))
    with pytest.raises(InvalidInputError, match=match):
        metrics.evaluate(posterior, *gaussian_pairs(120), num_samples=20)
