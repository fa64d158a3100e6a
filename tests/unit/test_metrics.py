"""Scores agree with closed forms and are careful with posteriors that misbehave."""

import contextlib
import math
import signal
import warnings
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from sbi.inference import NPE, DirectPosterior
from sbi.inference.posteriors import EnsemblePosterior
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from sbi.utils.tracking import TensorBoardTracker
from torch import Tensor
from torch.distributions import Gamma, Normal
from torch.utils.tensorboard import SummaryWriter

from sbi_rope import metrics
from sbi_rope.errors import InvalidInputError, LogProbUnavailableError
from tests import gaussian
from tests.refusals import assert_refused

KINDS = "central", "rank"
NORMAL = Normal(torch.tensor(0.0, dtype=torch.float64), 1.0)


class GaussianPosterior:
    """N(x + bias, scale^2) in every dimension, in sbi's shapes."""

    def __init__(self, bias: float = 0.0, scale: float | Tensor = 1.0) -> None:
        self.bias, self.scale = bias, torch.as_tensor(scale)
        self.batch_sizes: list[int] = []

    def sample_batched(
        self,
        sample_shape: torch.Size,
        x: Tensor,
        show_progress_bars: bool = True,
    ) -> Tensor:
        self.batch_sizes.append(len(x))
        noise = torch.randn(*sample_shape, *x.shape, dtype=x.dtype)
        return x + self.bias + self.scale * noise

    def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
        self.batch_sizes.append(len(x))
        theta = theta if theta.ndim > 2 else theta.unsqueeze(0)
        return Normal(x + self.bias, self.scale).log_prob(theta).sum(dim=-1)


class NoDensity(GaussianPosterior):
    """A posterior that can only be sampled."""

    log_prob_batched = property()  # type: ignore[assignment]


def acauc(posterior: Any, theta: Tensor, x: Tensor, kind: str, **options: Any) -> Any:
    """Return the ACAUC of central intervals, or that of ranks, the printed one."""
    found = metrics.evaluate(posterior, theta, x, **options)
    return found.acauc if kind == "central" else metrics.acauc_of(found.ranks)


def gaussian_pairs(n: int, d: int = 1) -> tuple[Tensor, Tensor]:
    """Theta given x is N(x, 1)."""
    x = 3.0 * torch.randn(n, d)
    return x + torch.randn(n, d), x


def expected_acauc(bias: float, scale: float, kind: str, *, num_samples: int) -> float:
    """Integrate the mean level over the distribution of the truth, N(0, 1).

    For many samples the rank is normal around the distribution function. The central
    level is then folded normal, whose mean is at least about 1 / sqrt(M).
    """
    z = torch.linspace(-9, 9, 20001, dtype=torch.float64)
    rank = NORMAL.cdf((z - bias) / scale)
    level = rank if kind == "rank" else (2 * rank - 1).abs()
    if kind == "central":
        spread = 2 * (rank * (1 - rank) / num_samples).sqrt().clamp(min=1e-12)
        fold = (2 / math.pi) ** 0.5 * spread * torch.exp(-0.5 * (level / spread) ** 2)
        level = fold + level * torch.erf(level / spread / 2**0.5)
    return float(torch.trapezoid(level * NORMAL.log_prob(z).exp(), z)) - 0.5


@contextlib.contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise if the body does not end in time, so that a test that hangs fails."""

    def stop(*_: Any) -> None:
        raise TimeoutError(f"still running after {seconds} s")

    previous = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


# Functions of ranks and levels --------------------------------------------------------


def test_mid_ranks_count_an_equal_sample_as_half_below() -> None:
    samples = torch.tensor([0.0, 1.0, 1.0, 2.0]).reshape(4, 1, 1)
    ranks = [float(metrics.mid_ranks(samples, torch.tensor([[t]]))) for t in (-1, 1, 3)]
    assert ranks == pytest.approx([0.5 / 5, 2.5 / 5, 4.5 / 5])
    infinite = torch.tensor([-torch.inf, 0.0, torch.inf]).reshape(3, 1, 1)
    assert float(metrics.mid_ranks(infinite, torch.tensor([[1.0]]))) == 2.5 / 4
    equal = metrics.mid_ranks(torch.ones(8, 3, 2), torch.ones(3, 2))
    assert torch.equal(equal, torch.full((3, 2), 0.5, dtype=torch.float64))


class Coin:
    """The exact posterior of a coin that shows its side in 95 % of the cases."""

    def sample_batched(
        self, sample_shape: torch.Size, x: Tensor, show_progress_bars: bool = True
    ) -> Tensor:
        return torch.bernoulli((0.05 + 0.9 * x).expand(*sample_shape, *x.shape))

    def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
        probability = torch.where(theta == x, 0.95, 0.05)
        return probability.log().sum(dim=-1).reshape(-1, len(x))


@pytest.mark.medium
def test_an_exact_posterior_of_a_discrete_parameter_is_calibrated() -> None:
    torch.manual_seed(0)
    theta = torch.bernoulli(torch.full((500, 1), 0.5))
    x = torch.where(torch.rand(500, 1) < 0.95, theta, 1 - theta)
    # In chunks, which must not repeat the same random numbers.
    for chunk_size in (1, 500):
        found = metrics.evaluate(
            Coin(), theta, x, num_samples=200, chunk_size=chunk_size, seed=0
        )
        assert found.acauc.verdict == "calibrated"
        assert abs(found.acauc.value) < 0.04
        assert found.expected_coverage_error.value < 0.04


GENERATOR = torch.Generator().manual_seed(0)
SAMPLES = torch.rand(7, 4, 2, generator=GENERATOR)
TRUTH = torch.rand(4, 2, generator=GENERATOR)
LEVEL_SCORES = (
    metrics.acauc_of,
    metrics.coverage_curve_of,
    metrics.expected_coverage_error_of,
)


def test_ranks_and_levels_outside_the_unit_interval_are_refused() -> None:
    for score in (*LEVEL_SCORES, metrics.central_levels):
        assert_refused(r"\[0, 1\]", score, TRUTH + 7)
        assert_refused(r"\[0, 1\]", score, TRUTH - 1)
    for score in LEVEL_SCORES:
        assert_refused("shape", score, TRUTH[:, :0])


def test_units_of_parameters_are_positive() -> None:
    score = metrics.LPPScore(log_probs=TRUTH[0])
    for units in ([1.0, -1.0], [1.0, 0.0], []):
        assert_refused("`theta_std`", score.standardised, torch.tensor(units))


def test_acauc_equals_its_integral_over_levels() -> None:
    levels = torch.rand(50, 3, dtype=torch.float64).mul(1000).floor() / 1000
    alpha = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    inside = (levels.unsqueeze(-1) <= alpha).double()
    integral = float((alpha - inside).mean())
    assert metrics.acauc_of(levels).value == pytest.approx(integral, abs=1e-5)


def test_acauc_standard_error_is_that_of_uniform_levels() -> None:
    score = metrics.acauc_of(torch.rand(2000, 1))
    assert score.standard_error == pytest.approx((1 / 12 / 2000) ** 0.5, rel=0.05)


def test_coverage_counts_a_level_that_is_equal_to_the_nominal_one() -> None:
    levels = metrics.central_levels(torch.tensor([[0.785], [0.5]], dtype=torch.float64))
    curve = metrics.coverage_curve_of(levels)
    assert curve.levels[56] == pytest.approx(0.57)
    assert curve.per_parameter[0, [0, 55, 56, 98]].tolist() == [0.5, 0.5, 1.0, 1.0]
    assert curve.num_observations == 2


def test_coverage_error_does_not_cancel_over_parameters() -> None:
    levels = torch.stack([torch.zeros(10), torch.ones(10)], dim=1)
    assert metrics.acauc_of(levels).value == 0.0
    score = metrics.expected_coverage_error_of(levels)
    assert score.per_parameter.tolist() == pytest.approx([0.5, 0.5])
    assert score.value == pytest.approx(0.5)


@pytest.mark.medium
@pytest.mark.parametrize("measured", [(400, 400, 400, 400), (40, 100, 400, 0)])
def test_coverage_error_of_calibrated_levels_has_its_expected_value(
    measured: tuple[int, ...],
) -> None:
    levels = torch.rand(40, 400, 4)
    for number, of_parameter in zip(measured, levels.unbind(dim=2), strict=True):
        of_parameter[:, number:] = math.nan
    errors = [metrics.expected_coverage_error_of(e) for e in levels]
    mean = sum(error.value for error in errors) / 40
    assert mean == pytest.approx(errors[0].if_calibrated, rel=0.1)
    curve = metrics.coverage_curve_of(levels[0])
    # The number that is as good for each parameter on average.
    parts = [number**-0.5 for number in measured if number]
    assert curve.num_observations == int((sum(parts) / len(parts)) ** -2 + 1e-9)


@pytest.mark.medium
def test_coverage_error_standard_error_matches_its_spread() -> None:
    # One parameter over-confident, one under-confident, by the same latent error.
    scales = torch.tensor([0.5, 2.0], dtype=torch.float64)

    def levels() -> Tensor:
        return metrics.central_levels(NORMAL.cdf(torch.randn(400, 1) / scales))

    scores = [metrics.expected_coverage_error_of(levels()) for _ in range(100)]
    spread = float(torch.tensor([score.value for score in scores]).std())
    assert scores[0].standard_error == pytest.approx(spread, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "d", "copies"), [(10, 1, 1), (10, 3, 1), (10, 1, 3)])
def test_calibrated_levels_of_ten_seldom_have_an_interval_without_zero(
    n: int, d: int, copies: int
) -> None:
    generator = torch.Generator().manual_seed(1)
    wrong = 0
    for _ in range(1000):
        levels = torch.rand(n, d, generator=generator).repeat(1, copies)
        wrong += metrics.acauc_of(levels).verdict != "calibrated"
    # In many more draws it is 4 to 5 %; with two standard errors it would be 8 %.
    assert 0.02 < wrong / 1000 < 0.06


def test_levels_too_large_are_over_confident_and_too_small_too_wide() -> None:
    levels = torch.rand(60, 2)
    assert metrics.acauc_of(levels.sqrt()).verdict == "over-confident"
    score = metrics.acauc_of(levels.square())
    assert score.verdict == "too wide"
    low, high = score.interval
    assert low < score.value < high < 0.0


# Gaussian posteriors with known scores ------------------------------------------------


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_acauc_of_a_factor_near_one_is_its_logarithm_divided_by_pi(
    factor: float,
) -> None:
    # The parameters are the quantiles of a normal distribution, in units of its width.
    shares = torch.linspace(0, 1, 10_001, dtype=torch.double)[1:-1, None]
    levels = torch.special.erf(factor * torch.special.ndtri(shares).abs() / 2**0.5)
    found = metrics.acauc_of(levels).value
    assert found == pytest.approx(math.log(factor) / math.pi, rel=0.01)


@pytest.mark.medium
def test_acauc_of_gaussian_posteriors_has_its_exact_and_its_published_value() -> None:
    theta, x = gaussian_pairs(1500)
    for bias, scale, *published in (
        (0.0, 1.0, 0.0015, -0.0001),  # calibrated
        (0.0, 0.3, 0.3127, -0.001),  # over-confident
        (0.0, 0.01, 0.492, 0.0),
        (0.0, 3.0, -0.298, 0.001),  # under-confident
        (0.0, 100.0, -0.474, 0.0),
        (2.0, 1.0, 0.356, -0.422),  # too high
        (-2.0, 1.0, 0.354, 0.421),  # too low
        (50.0, 0.1, 0.499, -0.5),
        (-50.0, 0.1, 0.499, 0.5),
    ):
        posterior = GaussianPosterior(bias, scale)
        for kind, table in zip(KINDS, published, strict=True):
            # All observations at a time, which takes a quarter of the time.
            score = acauc(posterior, theta, x, kind, chunk_size=1500)
            exact = expected_acauc(bias, scale, kind, num_samples=1000)
            case = f"{kind} at bias {bias} and scale {scale}: {score.value}"
            # 0.001: finitely many samples; 0.002: the error of the published value.
            assert abs(score.value - exact) < 4 * score.standard_error + 0.001, case
            assert abs(score.value - table) < 4 * score.standard_error + 0.002, case


def test_calibrated_posteriors_have_an_acauc_of_zero() -> None:
    theta, x = gaussian_pairs(2000, d=3)
    for kind in KINDS:
        score = acauc(GaussianPosterior(), theta, x, kind)
        assert abs(score.value) < 4 * score.standard_error, kind
        assert score.per_parameter.shape == (3,)


def test_skewed_but_exact_posteriors_have_an_acauc_of_zero() -> None:
    class GammaPosterior(GaussianPosterior):
        law = Gamma(torch.tensor([1.2]), torch.tensor([1.0]))

        def sample_batched(self, sample_shape: torch.Size, x: Tensor, **_: Any) -> Any:
            return x + self.law.sample((*sample_shape, len(x)))

        def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
            # The truth may lie at the edge of the support, up to rounding.
            return self.law.log_prob((theta - x).clamp(min=1e-6)).sum(dim=-1)

    x = torch.randn(1500, 1)
    theta = x + GammaPosterior.law.sample((1500,))
    for kind in KINDS:
        score = acauc(GammaPosterior(), theta, x, kind, num_samples=300)
        assert abs(score.value) < 4 * score.standard_error, kind


def test_coverage_of_gaussian_posteriors_follows_its_formula() -> None:
    theta, x = gaussian_pairs(2000, d=2)
    found = metrics.evaluate(GaussianPosterior(scale=0.5), theta, x)
    curve, error = found.coverage, found.expected_coverage_error
    expected = 2 * NORMAL.cdf(0.5 * NORMAL.icdf((1 + curve.levels) / 2)) - 1
    assert curve.per_parameter.shape == (2, 99)
    assert ((curve.average - expected).abs() < 5 * curve.standard_error + 0.002).all()
    distance = float((curve.levels - expected).mean())
    assert abs(error.value - distance) < 4 * error.standard_error + 0.001
    calibrated = metrics.evaluate(GaussianPosterior(), theta, x)
    assert calibrated.expected_coverage_error.value < 4 * 0.313 / 2000**0.5


# Log-probabilities --------------------------------------------------------------------


def test_lpp_of_a_gaussian_matches_its_closed_form() -> None:
    theta, x = gaussian_pairs(4000, d=2)
    score = metrics.lpp(GaussianPosterior(0.5, 2.0), theta, x)
    # -log s - log(2 pi)/2 - (1 + b^2) / (2 s^2), and the variance of the last term.
    expected = 2 * (-math.log(2.0) - 0.5 * math.log(2 * math.pi) - 1.25 / 8)
    variance = 2 * (2 + 4 * 0.25) / (4 * 2.0**4)
    assert score.standard_error == pytest.approx((variance / 4000) ** 0.5, rel=0.1)
    assert abs(score.mean - expected) < 4 * score.standard_error


def test_standardised_units_add_the_log_scales() -> None:
    theta, x = gaussian_pairs(20, d=2)
    theta_std = torch.tensor([3.0, 0.25])
    natural = metrics.lpp(GaussianPosterior(), theta, x)
    standardised = metrics.lpp(GaussianPosterior(), theta, x, theta_std=theta_std)
    # The same Gaussian, written in z = theta / s.
    scaled = Normal(x / theta_std, 1 / theta_std).log_prob(theta / theta_std).sum(1)
    assert torch.allclose(standardised.log_probs, scaled.double(), atol=1e-4)
    assert torch.equal(
        standardised.log_probs, natural.standardised(theta_std).log_probs
    )


def test_log_probs_of_minus_infinity_stay_in_the_mean_and_are_counted() -> None:
    log_probs = torch.tensor([-1.0, -2.0, -torch.inf, -3.0, -torch.inf])
    score = metrics.LPPScore(log_probs=log_probs)
    assert score.mean == -math.inf
    assert score.standard_error == math.inf
    assert score.median == -3.0
    assert score.neg_inf_fraction == pytest.approx(0.4)
    score = metrics.LPPScore(log_probs=torch.tensor([-1.0, -torch.inf, -torch.inf]))
    assert score.median == -math.inf
    assert str(score) == "-inf +- inf"
    assert str(metrics.LPPScore(log_probs=torch.tensor([-1.0, 0.0, 1.0, 2.0]))) == (
        "0.50 +- 0.65"
    )


# The whole evaluation -----------------------------------------------------------------


def test_evaluation_agrees_with_the_single_scores() -> None:
    theta, x = gaussian_pairs(80, d=2)
    posterior, std = GaussianPosterior(0.3, 0.7), torch.tensor([2.0, 5.0])
    result = metrics.evaluate(posterior, theta, x, theta_std=std, num_samples=100)
    levels = metrics.central_levels(result.ranks)
    assert result.as_row() == {
        "lpp": metrics.lpp(posterior, theta, x).mean,
        "lpp_z": metrics.lpp(posterior, theta, x, theta_std=std).mean,
        "lpp_median": metrics.lpp(posterior, theta, x).median,
        "neg_inf_fraction": 0.0,
        "acauc": metrics.acauc_of(levels).value,
        "expected_coverage_error": metrics.expected_coverage_error_of(levels).value,
    }


def test_a_seed_fixes_the_samples_and_leaves_the_global_random_state_alone() -> None:
    theta, x = gaussian_pairs(30)
    state = torch.get_rng_state()
    first = metrics.evaluate(GaussianPosterior(), theta, x, num_samples=20, seed=1)
    assert torch.equal(torch.get_rng_state(), state)
    torch.randn(7)
    again = metrics.evaluate(GaussianPosterior(), theta, x, num_samples=20, seed=1)
    other = metrics.evaluate(GaussianPosterior(), theta, x, num_samples=20, seed=2)
    assert torch.equal(first.ranks, again.ranks)
    assert not torch.equal(first.ranks, other.ranks)


class Uniform:
    """A prior of a user, which does not state its standard deviation."""

    def sample(self, shape: torch.Size) -> Tensor:
        return 6.0 * torch.rand(*shape, 1)


def test_the_unit_is_estimated_where_the_prior_does_not_state_it() -> None:
    posterior: Any = GaussianPosterior()
    posterior.prior = Uniform()
    found = metrics.evaluate(posterior, *gaussian_pairs(50), num_samples=50, seed=0)
    assert found.unit_z == "standard deviations of the prior"
    assert found.lpp_z is not None
    log_std = found.lpp_z.mean - found.lpp.mean
    assert log_std == pytest.approx(0.5 * math.log(3.0), abs=0.02)


def test_a_printed_evaluation_is_a_dozen_lines_that_name_their_units() -> None:
    theta, x = gaussian_pairs(300)
    std = torch.tensor([2.0])
    result = metrics.evaluate(
        GaussianPosterior(0.0, 0.3), theta, x, theta_std=std, num_samples=100, seed=0
    )
    text = str(result)
    assert 8 <= len(text.splitlines()) <= 12
    assert result.lpp_z is not None
    for unit, score in (("its own units", result.lpp), ("units of", result.lpp_z)):
        line = next(line for line in text.splitlines() if f"theta in {unit}" in line)
        assert f"{score.mean:.2f} +- {score.standard_error:.2f}" in line
    assert f"over-confident: ACAUC {result.acauc.value:+.3f}" in text
    assert "0 is calibrated, positive is over-confident, negative is too wide" in text
    inside = (metrics.central_levels(result.ranks) <= 0.9).double().mean()
    assert f"90% intervals {inside:.0%}" in text
    assert "density zero" not in text
    without = metrics.evaluate(GaussianPosterior(), theta, x, num_samples=50, seed=0)
    assert "pass theta_std=prior.stddev" in str(without)
    assert "calibrated as far as these observations can tell" in str(without)
    # Nobody knows whether this posterior has a prior that its mass could be outside of.
    assert "outside the prior" not in str(without)


# Posteriors of sbi --------------------------------------------------------------------


@pytest.fixture(scope="module")
def bounded_npe(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[DirectPosterior, Tensor, Tensor]]:
    """An NPE with a bounded prior, and observations far outside its training data."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        prior = BoxUniform(torch.zeros(2), torch.ones(2))
        theta = prior.sample((400,))
        x = theta + 0.1 * torch.randn_like(theta)
        # By default sbi logs into a folder of the working directory.
        tracker = TensorBoardTracker(SummaryWriter(tmp_path_factory.mktemp("logs")))
        npe = NPE(prior, density_estimator=posterior_nn("nsf"), tracker=tracker)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Maximum number of epochs")
            npe.append_simulations(theta, x).train(max_num_epochs=2)
        yield npe.build_posterior(), theta[:20], x[:20] + 1e3


def test_calibration_does_not_hang_where_no_sample_is_accepted(
    bounded_npe: tuple[DirectPosterior, Tensor, Tensor],
) -> None:
    npe, theta, x = bounded_npe
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        draws = npe.sample_batched((50,), x, reject_outside_prior=False)
    assert not npe.prior.support.check(draws).any()
    for posterior in (npe, EnsemblePosterior([npe, npe])):
        with at_most(10), warnings.catch_warnings():
            warnings.simplefilter("error")
            samples = metrics.draw_samples(posterior, x, num_samples=100)
        levels = metrics.central_levels(metrics.mid_ranks(samples, theta))
        assert metrics.acauc_of(levels).value > 0.4, posterior


def test_samples_are_drawn_where_the_rejection_of_sbi_would_not_end() -> None:
    x = torch.tensor([[0.5, -1.0], [2.0, 0.0]])
    far = BoxUniform(torch.full((2,), 100.0), torch.full((2,), 101.0))
    posterior = DirectPosterior(gaussian.GaussianEstimator(), far)
    for call in (
        lambda: posterior.sample((10,), x=x[0], max_sampling_time=0.1),
        lambda: posterior.sample_batched((10,), x=x, max_sampling_time=0.1),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with at_most(10), pytest.raises(RuntimeError, match="max_sampling_time"):
                call()
    with at_most(10):
        samples = metrics.draw_samples(posterior, x, num_samples=4000)
    mean, std = gaussian.GAIN * x, torch.tensor(gaussian.POSTERIOR_STD)
    assert torch.allclose(samples.mean(dim=0), mean, atol=5 * float(std) / 4000**0.5)
    assert torch.allclose(samples.std(dim=0), std.expand(2, 2), rtol=0.1)


def test_log_probs_of_an_npe_are_those_of_its_network_inside_the_prior(
    bounded_npe: tuple[DirectPosterior, Tensor, Tensor],
) -> None:
    posterior, theta, x = bounded_npe
    with at_most(10):
        result = metrics.evaluate(posterior, theta, x, num_samples=50)
    assert "not corrected for mass outside the prior" in str(result)
    raw = posterior.posterior_estimator.log_prob(theta.unsqueeze(0), x)[0]
    assert torch.allclose(result.lpp.log_probs, raw.detach().double(), rtol=1e-5)
    double = metrics.lpp(posterior, theta.double(), x.double())
    assert torch.equal(double.log_probs, result.lpp.log_probs)
    outside = metrics.lpp(posterior, torch.cat([theta, theta + 5]), x.repeat(2, 1))
    assert outside.neg_inf_fraction == 0.5


def test_a_posterior_with_bounded_rejection_is_called_as_it_is(
    bounded_npe: tuple[DirectPosterior, Tensor, Tensor],
) -> None:
    class Bounded(DirectPosterior):
        def leakage_correction(self, x: Tensor, **options: Any) -> Any:
            raise AssertionError("only looked at")

        def sample_batched(self, sample_shape: Any, x: Tensor, **options: Any) -> Any:
            assert set(options) == {"show_progress_bars"}
            return torch.rand(*sample_shape, len(x), 2)

        def log_prob_batched(self, theta: Tensor, x: Tensor, **options: Any) -> Any:
            assert options == {}
            return torch.zeros(theta.shape[:-1]).reshape(-1, len(x))

    npe, theta, x = bounded_npe
    posterior = Bounded(npe.posterior_estimator, npe.prior)
    result = metrics.evaluate(posterior, theta, x, num_samples=20)
    assert result.lpp.mean == 0.0
    assert "    corrected for mass outside the prior" in str(result)


# Errors -------------------------------------------------------------------------------


def test_an_evaluation_says_what_is_wrong_with_parameters_and_their_units() -> None:
    class AnyWidth(GaussianPosterior):
        def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
            return torch.zeros(1, len(x))

    theta, x = gaussian_pairs(12, d=2)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"theta": theta.repeat(1, 2)}, "of shape"),
        ({"theta": theta[:, :0]}, "at least one number"),
        ({"theta_std": torch.ones(3)}, "theta_std"),
        ({"theta_std": torch.tensor([1.0, 0.0])}, "`theta_std` to be a number above 0"),
        ({"num_samples": 19}, "`num_samples`"),
    ]
    good: dict[str, Any] = {"theta": theta, "x": x, "num_samples": 20}
    for change, match in cases:
        assert_refused(match, metrics.evaluate, AnyWidth(), **good | change)


def test_a_posterior_without_density_can_still_be_scored_by_its_calibration() -> None:
    theta, x = gaussian_pairs(30)
    for score in (metrics.lpp, metrics.evaluate):
        with pytest.raises(LogProbUnavailableError, match="NoDensity"):
            score(NoDensity(), theta, x)
    samples = metrics.draw_samples(NoDensity(), x, num_samples=20)
    levels = metrics.central_levels(metrics.mid_ranks(samples, theta))
    assert metrics.acauc_of(levels).standard_error > 0


def test_nan_and_infinite_log_probs_raise_and_say_where() -> None:
    class Broken(GaussianPosterior):
        def log_prob_batched(self, theta: Tensor, x: Tensor) -> Tensor:
            return torch.where(x[:, 0] == 7.0, self.bias, x[:, 0]).unsqueeze(0)

    x = torch.arange(12.0).unsqueeze(1)
    for value in (math.nan, math.inf):
        with pytest.raises(InvalidInputError, match=r"first: \[7\]"):
            metrics.lpp(Broken(bias=value), x, x, chunk_size=5)


def test_nan_samples_raise_and_say_where() -> None:
    class Broken(GaussianPosterior):
        def sample_batched(self, sample_shape: torch.Size, x: Tensor, **_: Any) -> Any:
            return torch.where(x == 7.0, torch.nan, x).expand(*sample_shape, *x.shape)

    x = torch.arange(12.0).unsqueeze(1)
    with pytest.raises(InvalidInputError, match=r"NaN samples.*first: \[7\]"):
        metrics.evaluate(Broken(), x, x, chunk_size=5)


def test_acauc_standard_error_does_not_count_copies_of_a_parameter() -> None:
    levels = torch.rand(100, 1)
    copies = metrics.acauc_of(levels.expand(-1, 5))
    assert copies.standard_error == pytest.approx(
        metrics.acauc_of(levels).standard_error
    )
