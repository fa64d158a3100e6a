"""RNPE: a mean of NPE over denoised statistics."""

import functools
import math
from typing import Any

import pytest
import torch
from torch.distributions import Normal

from sbi_rope.baselines import RNPE, SpikeAndSlab, Training
from sbi_rope.baselines.rnpe import fit_marginal
from sbi_rope.metrics import evaluate
from sbi_rope.utils.errors import RoPEWarning
from tests import gaussian

# theta ~ N(0, 1), x = theta + 0.5 eps, q(theta | s) = N(s, 0.2) with s = 0.8 x.
STATISTIC_STD = gaussian.GAIN * (1 + gaussian.NOISE_STD**2) ** 0.5
X_O = torch.tensor([[0.0], [1.0], [3.5], [40.0]])
ONCE = Training(max_num_epochs=1)
QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}


@functools.cache
def one_statistic(noise_on: str = "embedding") -> Any:
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
    return method.train(**QUIET).build_posterior()


def quick_posterior(**options: Any) -> Any:
    """Two statistics, few draws."""
    options = {"num_denoised": 20, "warmup": 5, "thin": 1, "training": ONCE} | options
    theta = gaussian.prior().sample(torch.Size((200,)))
    method = RNPE.from_posterior(gaussian.posterior(), **options)
    method.append_simulations(theta, gaussian.simulator(theta))
    return method.train(**QUIET).build_posterior()


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
    posterior = one_statistic(noise_on)
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
    s = posterior.posterior_estimator.embed(x)
    law = Normal(s, gaussian.POSTERIOR_STD)
    log_q = law.log_prob(theta[:, :, None]).sum(dim=-1)
    expected = log_q.logsumexp(dim=-1) - math.log(s.shape[1])
    assert torch.allclose(values, expected, atol=1e-4)


@pytest.mark.medium
def test_with_one_wrong_statistic_it_is_far_better_than_npe() -> None:
    """Two parameters with a reading each; the second reading is off by 20 sd."""
    posterior = quick_posterior(
        training=Training(learning_rate=2e-3, max_num_epochs=60)
    )
    theta = gaussian.prior().sample(torch.Size((30,)))
    x = gaussian.simulator(theta) + torch.tensor([0.0, 20.0])
    found, of_npe = (
        evaluate(one, theta, x, num_samples=20).lpp.mean
        for one in (posterior, gaussian.posterior())
    )
    assert found > of_npe + 50.0
    assert found > gaussian.prior().log_prob(theta).mean()


@pytest.mark.medium
def test_the_marginal_density_is_that_of_the_statistics() -> None:
    mixing = torch.tensor([[1.0, 0.8], [0.0, 0.6]])
    s, fresh = torch.randn(2000, 2) @ mixing, torch.randn(2000, 2) @ mixing
    training = Training(learning_rate=5e-3, max_num_epochs=25)
    flow, _ = fit_marginal(s, jitter=0.01, training=training, show_progress_bars=False)
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


# --- the posterior as an object ---


@pytest.mark.medium
def test_what_was_denoised_is_kept_and_leaves_the_random_state_alone() -> None:
    denoised, x = quick_posterior().posterior_estimator, torch.randn(3, 2)
    state = torch.get_rng_state()
    first = denoised.embed(x)
    assert torch.equal(torch.get_rng_state(), state)
    # In other company and order.
    assert torch.equal(denoised.embed(x[[2, 0]]), first[[2, 0]])
    mixed = torch.cat([torch.randn(2, 2), x[1:2]])
    assert torch.equal(denoised.embed(mixed)[2], first[1])


def test_chains_that_disagree_are_warned_of_and_measured() -> None:
    denoised = quick_posterior(num_denoised=16, warmup=1).posterior_estimator
    # Where spike and slab compete, a few draws do not tell their shares.
    x = torch.linspace(3.3, 4.2, 10)[:, None] * torch.tensor([1.0, -1.0])
    with pytest.warns(RoPEWarning, match="R-hat"):
        denoised.embed(x)
    assert (denoised.r_hat(x) > 1.1).any()
