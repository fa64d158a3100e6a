"""RNPE: a mean of NPE over denoised statistics."""

import functools
import math
import pickle
from typing import Any

import pytest
import torch
from torch import nn
from torch.distributions import Normal

from sbi_rope._sbi import estimator_of
from sbi_rope._standardisation import Standardisation
from sbi_rope.baselines.error_model import SpikeAndSlab
from sbi_rope.baselines.rnpe import RNPE, DenoisedEmbeddings
from sbi_rope.baselines.statistics import fit_marginal
from sbi_rope.errors import (
    InvalidInputError,
    NotReadyError,
    RoPEWarning,
    UnsupportedPosteriorError,
)
from sbi_rope.metrics import lpp
from sbi_rope.trainers.training import Training
from tests import gaussian, problems

# theta ~ N(0, 1), x = theta + 0.5 eps, q(theta | s) = N(s, 0.2) with s = 0.8 x.
STATISTIC_STD = gaussian.GAIN * (1 + gaussian.NOISE_STD**2) ** 0.5
X_O = torch.tensor([[0.0], [1.0], [3.5], [40.0]])


@functools.cache
def one_statistic(noise_on: str = "embedding") -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        theta = gaussian.prior(1).sample(torch.Size((3000,)))
        method = RNPE.from_posterior(
            gaussian.posterior(1),
            noise_on=noise_on,
            num_denoised=800,
            num_chains=20,
            warmup=20,
            thin=1,
            training=Training(learning_rate=5e-3, max_num_epochs=25),
        )
        method.append_simulations(theta, gaussian.simulator(theta))
        return method.train(seed=0, show_progress_bars=False)


def quick(posterior: Any = None, **options: Any) -> RNPE:
    """Two statistics, few draws."""
    fast = Training(max_num_epochs=1)
    options = {"num_denoised": 20, "warmup": 5, "thin": 1, "training": fast, **options}
    npe = gaussian.posterior() if posterior is None else posterior
    theta = gaussian.prior().sample(torch.Size((200,)))
    method = RNPE.from_posterior(npe, **options)
    return method.append_simulations(theta, gaussian.simulator(theta))


def quick_posterior(**options: Any) -> Any:
    return quick(**options).train(seed=0, show_progress_bars=False).build_posterior()


def mixing_of(posterior: Any) -> DenoisedEmbeddings:
    return posterior.posterior_estimator.parts[0].mixing


def closed_form(x: float) -> tuple[float, float]:
    """Mean and sd of theta given x, by quadrature over s in units of its sd."""
    y = gaussian.GAIN * x / STATISTIC_STD
    s = torch.cat(
        [torch.linspace(-9, 9, 100_001), torch.linspace(y - 0.1, y + 0.1, 9999)]
    )
    s = s.double().sort().values
    log_density = Normal(0.0, 1.0).log_prob(s) + SpikeAndSlab().log_prob(y - s)
    density = (log_density - log_density.max()).exp()
    density = density / torch.trapezoid(density, s)
    mean = torch.trapezoid(density * s, s)
    variance = torch.trapezoid(density * (s - mean) ** 2, s)
    total = STATISTIC_STD**2 * variance + gaussian.POSTERIOR_STD**2
    return float(STATISTIC_STD * mean), float(total) ** 0.5


# --- against known answers ---


@pytest.mark.medium
@pytest.mark.parametrize(
    "noise_on", ["embedding", pytest.param("input", marks=pytest.mark.slow)]
)
def test_one_gaussian_statistic_gives_the_posterior_found_by_quadrature(
    noise_on: str,
) -> None:
    # Of one statistic, input and embedding are the same in standard deviations.
    posterior = one_statistic(noise_on).build_posterior()
    theta = posterior.sample_batched((3000,), x=X_O, show_progress_bars=False)
    for x, draws in zip(X_O[:, 0], theta[..., 0].T, strict=True):
        mean, std = closed_form(float(x))
        assert float(draws.mean()) == pytest.approx(mean, abs=0.2)
        assert float(draws.std()) == pytest.approx(std, rel=0.15)


@pytest.mark.medium
def test_log_prob_is_the_mean_density_over_the_denoised_statistics() -> None:
    posterior = quick_posterior()
    x, theta = torch.randn(3, 2), torch.randn(4, 3, 2)
    values = posterior.log_prob_batched(theta, x=x, norm_posterior=False)
    s = mixing_of(posterior).embed(x)
    for sample in range(4):
        for row in range(3):
            terms = [
                float(
                    Normal(one, gaussian.POSTERIOR_STD)
                    .log_prob(theta[sample, row])
                    .sum()
                    .exp()
                )
                for one in s[row]
            ]
            expected = math.log(sum(terms) / len(terms))
            assert float(values[sample, row]) == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_samples_follow_the_density() -> None:
    posterior = one_statistic().build_posterior()
    x = X_O[2:3]
    theta = posterior.sample((4000,), x=x, show_progress_bars=False)[:, 0]
    grid = torch.linspace(-6, 6, 2001)
    density = posterior.log_prob(grid[:, None], x=x, norm_posterior=False).exp()
    assert float(torch.trapezoid(density, grid)) == pytest.approx(1.0, abs=1e-3)
    cumulative = torch.cumulative_trapezoid(density, grid)
    for point in (500, 900, 1100, 1300, 1500):
        share = float((theta < grid[point]).float().mean())
        assert share == pytest.approx(float(cumulative[point - 1]), abs=0.03)


@pytest.mark.medium
def test_with_one_wrong_statistic_it_is_far_better_than_npe() -> None:
    """Two parameters with a reading each; the second reading is off by 20 sd."""
    posterior = quick_posterior(
        training=Training(learning_rate=2e-3, max_num_epochs=60)
    )
    theta = gaussian.prior().sample(torch.Size((30,)))
    x = gaussian.simulator(theta) + torch.tensor([0.0, 20.0])
    exact = gaussian.posterior()
    assert lpp(posterior, theta, x).mean > lpp(exact, theta, x).mean + 50.0
    assert lpp(posterior, theta, x).mean > gaussian.prior().log_prob(theta).mean()


@pytest.mark.medium
def test_the_marginal_density_is_that_of_the_statistics() -> None:
    s = torch.randn(2000, 2)
    s[:, 1] = 0.8 * s[:, 0] + 0.6 * s[:, 1]
    flow, history = fit_marginal(
        s,
        jitter=0.01,
        training=Training(learning_rate=5e-3, max_num_epochs=25),
        show_progress_bars=False,
    )
    entropy = math.log(2 * math.pi * math.e) + math.log(0.6)
    fresh = torch.randn(2000, 2)
    fresh[:, 1] = 0.8 * fresh[:, 0] + 0.6 * fresh[:, 1]
    with torch.no_grad():
        assert float(flow.loss(fresh).mean()) == pytest.approx(entropy, abs=0.12)
    assert history.kept_validation_loss == pytest.approx(entropy, abs=0.3)


def test_the_marginal_density_starts_as_a_standard_normal_one() -> None:
    for dim in [1, 3]:
        s = torch.randn(50, dim)
        still = Training(learning_rate=1e-12, max_num_epochs=1)
        flow, _ = fit_marginal(s, jitter=0.01, training=still, show_progress_bars=False)
        far = 3.0 * torch.randn(100, dim)
        expected = Normal(0.0, 1.0).log_prob(far).sum(dim=-1)
        with torch.no_grad():
            assert torch.allclose(-flow.loss(far), expected, atol=0.3)


def test_without_simulations_the_marginal_density_keeps_its_gaussian_tails() -> None:
    s = torch.randn(1000, 1)
    training = Training(learning_rate=5e-3, max_num_epochs=25)
    flow, _ = fit_marginal(s, jitter=0.01, training=training, show_progress_bars=False)
    far = torch.tensor([[-4.5], [4.5], [6.0]])
    expected = Normal(0.0, 1.0).log_prob(far)[:, 0]
    with torch.no_grad():
        assert torch.allclose(-flow.loss(far), expected, atol=1.5)


# --- standardisation ---


def test_standardised_statistics_have_unit_variance_and_lead_back() -> None:
    s = 3.0 + torch.tensor([1e-3, 50.0]) * torch.randn(200, 2)
    standardisation = Standardisation(s)
    z = standardisation(s)
    assert torch.allclose(z.mean(dim=0), torch.zeros(2), atol=1e-4)
    assert torch.allclose(z.std(dim=0), torch.ones(2), atol=1e-4)
    assert torch.allclose(standardisation.undo(z), s, rtol=1e-4)


def test_constant_statistics_are_left_out_and_come_back_as_simulated() -> None:
    s = torch.randn(200, 4)
    s[:, 0], s[:, 2] = 0.0, 0.1
    standardisation = Standardisation(s)
    z = standardisation(s + torch.tensor([9.0, 0.0, 9.0, 0.0]))
    assert z.shape == (200, 2)
    assert torch.isfinite(z).all()
    assert torch.allclose(standardisation.undo(z), s, atol=1e-5)


# --- the posterior as an object ---


@pytest.mark.medium
def test_what_was_denoised_is_kept() -> None:
    posterior = quick_posterior()
    mixing, x = mixing_of(posterior), torch.randn(3, 2)
    first = mixing.embed(x)
    # In other company and order, and as -0 for 0.
    assert torch.equal(mixing.embed(x[[2, 0]]), first[[2, 0]])
    mixed = torch.cat([torch.randn(2, 2), x[1:2]])
    assert torch.equal(mixing.embed(mixed)[2], first[1])
    zero = mixing.embed(torch.zeros(1, 2))
    num_kept = len(mixing._denoised)
    assert torch.equal(mixing.embed(-torch.zeros(1, 2)), zero)
    assert len(mixing._denoised) == num_kept


@pytest.mark.medium
def test_two_posteriors_of_one_training_are_the_same_function() -> None:
    method = quick().train(seed=0, show_progress_bars=False)
    theta, x = torch.randn(3, 2), torch.randn(3, 2)
    values = [
        method.build_posterior().log_prob_batched(theta, x=x, norm_posterior=False)
        for _ in range(2)
    ]
    assert torch.equal(*values)


def test_denoising_leaves_the_random_numbers_of_the_caller_alone() -> None:
    posterior = quick_posterior()
    state = torch.get_rng_state()
    mixing_of(posterior).embed(torch.randn(1, 2))
    torch.set_rng_state(state)
    expected = torch.randn(1, 2)
    torch.set_rng_state(state)
    torch.randn(1, 2)
    mixing_of(posterior).embed(expected)
    after = torch.randn(1)
    torch.set_rng_state(state)
    torch.randn(1, 2)
    assert torch.equal(after, torch.randn(1))


def test_the_posterior_survives_pickling_with_what_was_denoised() -> None:
    posterior = quick_posterior()
    theta, x = torch.randn(3, 2), torch.randn(3, 2)
    values = posterior.log_prob_batched(theta, x=x, norm_posterior=False)
    again = pickle.loads(pickle.dumps(posterior))
    assert len(mixing_of(again)._denoised) == 3
    assert torch.equal(again.log_prob_batched(theta, x=x, norm_posterior=False), values)


def test_one_observation_serves_many_parameters_and_gradients_flow() -> None:
    posterior = quick_posterior().set_default_x(torch.zeros(1, 2))
    theta = torch.randn(7, 2, requires_grad=True)
    value = posterior.log_prob(theta, norm_posterior=False, track_gradients=True)
    assert value.shape == (7,)
    value.sum().backward()
    assert theta.grad is not None
    assert (theta.grad != 0).any(dim=1).all()


@pytest.mark.medium
def test_samples_have_the_shapes_of_an_estimator() -> None:
    for sample_shape in [(), (5,), (4, 5)]:
        estimator = quick_posterior().posterior_estimator
        draws = estimator.sample(torch.Size(sample_shape), torch.randn(3, 2))
        assert draws.shape == (*sample_shape, 3, 2)


@pytest.mark.slow
def test_estimators_of_sbi_can_be_averaged() -> None:
    for family in ["mdn", "nsf", "zuko_maf"]:
        theta = problems.box(2).sample((200,))
        method = RNPE.from_posterior(
            problems.npe_posterior(family),
            num_denoised=16,
            warmup=2,
            thin=1,
            training=Training(max_num_epochs=1),
        )
        method.append_simulations(theta, problems.simulate(theta))
        posterior = method.train(seed=0, show_progress_bars=False).build_posterior()
        assert posterior.posterior_estimator.condition_shape == (3,)
        x = torch.randn(2, 3)
        with pytest.warns(RoPEWarning, match="converged"):
            values = posterior.log_prob_batched(theta[:2], x=x, norm_posterior=False)
        assert torch.isfinite(values).all()


# --- convergence and wrong use ---


def test_chains_that_disagree_are_warned_of_and_measured() -> None:
    posterior = quick_posterior(num_denoised=16, warmup=1)
    # Where spike and slab compete, a few draws do not tell their shares.
    x = torch.linspace(3.3, 4.2, 10)[:, None] * torch.tensor([1.0, -1.0])
    with pytest.warns(RoPEWarning, match="R-hat"):
        mixing_of(posterior).embed(x)
    assert (mixing_of(posterior).r_hat(x) > 1.1).any()


@pytest.mark.medium
def test_chains_that_agree_are_not_warned_of(recwarn: Any) -> None:
    mixing = mixing_of(one_statistic().build_posterior())
    assert (mixing.r_hat(X_O[:2]) < 1.1).all()
    assert not [w for w in recwarn if issubclass(w.category, RoPEWarning)]


def test_a_trained_npe_alone_is_not_enough() -> None:
    with pytest.raises(NotReadyError, match="append_simulations"):
        RNPE.from_posterior(gaussian.posterior()).train()


def test_images_are_no_list_of_statistics() -> None:
    theta = problems.box(2).sample((50,))
    npe = problems.npe_posterior("maf", "cnn")
    method = RNPE.from_posterior(npe, noise_on="input")
    method.append_simulations(theta, problems.simulate_image(theta))
    with pytest.raises(InvalidInputError, match="noise_on='embedding'"):
        method.train(show_progress_bars=False)


def test_statistics_that_never_vary_are_refused() -> None:
    npe = gaussian.posterior()
    with torch.no_grad():
        estimator_of(npe).net.weight.zero_()  # type: ignore[union-attr]
    with pytest.raises(InvalidInputError, match="constant"):
        quick(npe).train(show_progress_bars=False)


def test_an_observation_that_is_not_finite_is_refused() -> None:
    mixing = mixing_of(quick_posterior())
    with pytest.raises(InvalidInputError, match="finite"):
        mixing.embed(torch.tensor([[0.0, math.nan]]))


def test_vector_fields_are_refused() -> None:
    npe = problems.vector_field_posterior("fmpe")
    theta = problems.box(2).sample((50,))
    method = RNPE.from_posterior(npe)
    method.append_simulations(theta, problems.simulate(theta))
    with pytest.raises(UnsupportedPosteriorError, match="density"):
        method.train(show_progress_bars=False)


def test_options_out_of_range_are_refused() -> None:
    for name, value in [
        ("noise_on", "output"),
        ("num_denoised", 3),
        ("num_chains", 1),
        ("warmup", 0),
        ("thin", 0),
    ]:
        with pytest.raises(InvalidInputError, match=name):
            RNPE(gaussian.prior(), **{name: value})


def test_an_error_model_of_another_type_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="error_model"):
        RNPE(gaussian.prior(), error_model=nn.Identity())  # type: ignore[arg-type]


@pytest.mark.medium
def test_far_observations_are_treated_as_at_the_bound() -> None:
    mixing = mixing_of(quick_posterior())
    far, farther = (mixing.embed(torch.tensor([[value, 0.0]])) for value in (1e8, 1e9))
    assert torch.isfinite(far).all()
    assert torch.equal(far, farther)
