"""RNPE: its error model, and a mean of NPE over denoised statistics."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.distributions import Cauchy, MultivariateNormal, Normal

from sbi_rope.baselines import RNPE, SpikeAndSlab
from sbi_rope.baselines.error_model import denoise, split_r_hat
from sbi_rope.baselines.rnpe import fit_marginal
from sbi_rope.methods import Training
from sbi_rope.metrics import evaluate
from sbi_rope.utils.errors import RoPEWarning
from tests import gaussian
from tests.baselines import log_prob, train

# theta ~ N(0, 1), x = theta + 0.5 eps, q(theta | s) = N(s, 0.2) with s = 0.8 x.
STATISTIC_STD = gaussian.GAIN * (1 + gaussian.NOISE_STD**2) ** 0.5
X_O = torch.tensor([[0.0], [1.0], [3.5], [40.0]])
FITTED = Training(learning_rate=5e-3, max_num_epochs=25)

# --- the noise ---


def test_the_share_of_large_errors_is_that_of_the_slab_beyond() -> None:
    noise = SpikeAndSlab().sample_like(torch.empty(200_000))
    for size in (0.1, 1.0, 10.0):
        expected = 0.5 * (1 - 2 / math.pi * math.atan(size / 0.25))
        share = float((noise.abs() > size).float().mean())
        assert abs(share - expected) < 4 * (expected / len(noise)) ** 0.5
    wide = SpikeAndSlab(slab_scale=100.0).sample_like(torch.empty(10_000))
    assert float(wide.max()) == -float(wide.min()) == 1000.0  # the bound


def test_the_density_is_the_mixture_of_both_laws() -> None:
    for share in [0.0, 0.3, 1.0]:
        model = SpikeAndSlab(spike_std=0.1, slab_scale=0.5, slab_probability=share)
        noise = torch.linspace(-3, 3, 101).double()
        zero = torch.zeros(()).double()
        spike = Normal(zero, zero + 0.1).log_prob(noise).exp()
        slab = Cauchy(zero, zero + 0.5).log_prob(noise).exp()
        expected = (1 - share) * spike + share * slab
        assert torch.allclose(model.log_prob(noise).exp(), expected, rtol=1e-6)


# --- denoising ---


@pytest.mark.medium
def test_with_gaussian_errors_denoising_is_the_kalman_update() -> None:
    covariance = torch.tensor([[1.0, 0.8], [0.8, 1.0]])
    q = MultivariateNormal(torch.zeros(2), covariance)
    y = torch.tensor([[1.0, -1.0], [2.0, 0.5]])
    draws, _ = denoise(
        y,
        log_density=q.log_prob,
        simulated=q.sample(torch.Size((500,))),
        error_model=SpikeAndSlab(spike_std=0.5, slab_probability=0.0),
        num_draws=1000,
        num_chains=20,
        warmup=30,
        thin=2,
    )
    gain = covariance @ torch.linalg.inv(covariance + 0.25 * torch.eye(2))
    posterior = covariance - gain @ covariance
    for observation, s in zip(y, draws, strict=True):
        assert torch.allclose(s.mean(dim=0), gain @ observation, atol=0.1)
        assert torch.allclose(torch.cov(s.T), posterior, atol=0.08)


def test_r_hat_is_the_textbook_ratio_of_variances() -> None:
    draws = torch.randn(3, 4, 10, 2).double()
    result = split_r_hat(draws)
    for i, d in np.ndindex(3, 2):
        chains = draws[i, :, :, d].numpy().reshape(8, 5)
        within = chains.var(axis=1, ddof=1).mean()
        between = 5 * chains.mean(axis=1).var(ddof=1)
        expected = np.sqrt((4 / 5 * within + between / 5) / within)
        assert float(result[i, d]) == pytest.approx(expected)
    drifting = torch.randn(4, 1000, 1) + torch.linspace(0, 5, 1000)[:, None]
    assert float(split_r_hat(drifting)) > 1.3


# --- the density of the statistics ---


@pytest.mark.medium
def test_the_marginal_density_is_that_of_the_statistics() -> None:
    mixing = torch.tensor([[1.0, 0.8], [0.0, 0.6]])
    s, fresh = torch.randn(2000, 2) @ mixing, torch.randn(2000, 2) @ mixing
    flow, _ = fit_marginal(s, jitter=0.01, training=FITTED, show_progress_bars=False)
    entropy = math.log(2 * math.pi * math.e) + math.log(0.6)
    assert float(flow.loss(fresh).mean()) == pytest.approx(entropy, abs=0.12)


def test_the_marginal_density_starts_as_a_standard_normal_one() -> None:
    for dim in [1, 3]:
        s = torch.randn(50, dim)
        still = Training(learning_rate=1e-12, max_num_epochs=1)
        flow, _ = fit_marginal(s, jitter=0.01, training=still, show_progress_bars=False)
        far = 3.0 * torch.randn(100, dim)
        expected = Normal(0.0, 1.0).log_prob(far).sum(dim=-1)
        assert torch.allclose(-flow.loss(far), expected, atol=0.3)


# --- the method ---


def repaired(dim: int, n: int, **options: Any) -> Any:
    theta = gaussian.prior(dim).sample(torch.Size((n,)))
    method = RNPE.from_posterior(gaussian.posterior(dim), thin=1, **options)
    method.append_simulations(theta, gaussian.simulator(theta))
    return train(method).build_posterior()


def quick_posterior(**options: Any) -> Any:
    """Two statistics, few draws."""
    once = Training(max_num_epochs=1)
    options = {"num_denoised": 20, "warmup": 5, "training": once} | options
    return repaired(2, 200, **options)


def by_quadrature(x: float) -> tuple[float, float]:
    """Mean and sd of theta given x, by quadrature over s in units of its sd."""
    y = gaussian.GAIN * x / STATISTIC_STD
    around_y = torch.linspace(y - 0.1, y + 0.1, 9999)
    s = torch.cat([torch.linspace(-9, 9, 100_001), around_y]).double().sort().values
    log_density = Normal(0.0, 1.0).log_prob(s) + SpikeAndSlab().log_prob(y - s)
    density = (log_density - log_density.max()).exp()
    density = density / torch.trapezoid(density, s)
    mean = torch.trapezoid(density * s, s)
    variance = torch.trapezoid(density * (s - mean) ** 2, s)
    total = STATISTIC_STD**2 * variance + gaussian.POSTERIOR_STD**2
    return float(STATISTIC_STD * mean), float(total) ** 0.5


@pytest.mark.medium
def test_one_gaussian_statistic_gives_the_posterior_found_by_quadrature() -> None:
    posterior = repaired(
        1, 3000, num_denoised=800, num_chains=20, warmup=20, training=FITTED
    )
    theta = posterior.sample_batched((3000,), x=X_O, show_progress_bars=False)
    for x, draws in zip(X_O[:, 0], theta[..., 0].T, strict=True):
        mean, std = by_quadrature(float(x))
        assert float(draws.mean()) == pytest.approx(mean, abs=0.2)
        assert float(draws.std()) == pytest.approx(std, rel=0.15)


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:RNPE. the chains")
def test_with_one_wrong_statistic_it_is_far_better_than_npe() -> None:
    """Two parameters with a reading each; the second reading is off by 20 sd."""
    training = Training(learning_rate=2e-3, max_num_epochs=60)
    posterior = quick_posterior(training=training)
    theta = gaussian.prior().sample(torch.Size((30,)))
    x = gaussian.simulator(theta) + torch.tensor([0.0, 20.0])
    found, of_npe = (
        evaluate(one, theta, x, num_samples=20).lpp.mean
        for one in (posterior, gaussian.posterior())
    )
    assert found > of_npe + 50.0
    assert found > gaussian.prior().log_prob(theta).mean()


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:RNPE. the chains")
def test_it_averages_over_draws_that_are_kept_and_leave_no_trace() -> None:
    posterior, x = quick_posterior(), torch.randn(3, 2)
    denoised, state = posterior.posterior_estimator, torch.get_rng_state()
    s = denoised.embed(x)
    assert torch.equal(torch.get_rng_state(), state)
    # In other company and order.
    assert torch.equal(denoised.embed(x[[2, 0]]), s[[2, 0]])
    mixed = torch.cat([torch.randn(2, 2), x[1:2]])
    assert torch.equal(denoised.embed(mixed)[2], s[1])
    theta = torch.randn(4, 3, 2)
    law = Normal(s, gaussian.POSTERIOR_STD)
    log_q = law.log_prob(theta[:, :, None]).sum(dim=-1)
    expected = log_q.logsumexp(dim=-1) - math.log(s.shape[1])
    assert torch.allclose(log_prob(posterior, theta, x), expected, atol=1e-4)


def test_chains_that_disagree_are_warned_of() -> None:
    denoised = quick_posterior(num_denoised=16, warmup=1).posterior_estimator
    # Where spike and slab compete, a few draws do not tell their shares.
    x = torch.linspace(3.3, 4.2, 10)[:, None] * torch.tensor([1.0, -1.0])
    with pytest.warns(RoPEWarning, match="R-hat"):
        denoised.embed(x)
