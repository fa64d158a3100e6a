"""Spike and slab: its moments, its density, and what is left after denoising."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Cauchy, MultivariateNormal, Normal

from sbi_rope.baselines.error_model import SpikeAndSlab, denoise, split_r_hat
from sbi_rope.utils.seeds import seeded

MODEL = SpikeAndSlab()


def standard_normal(s: Tensor) -> Tensor:
    return Normal(0.0, 1.0).log_prob(s).sum(dim=-1)


def denoised(y: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
    settings: dict[str, Any] = {
        "log_density": standard_normal,
        "simulated": torch.randn(500, y.shape[1]),
        "error_model": MODEL,
        "num_draws": 1000,
        "num_chains": 20,
        "warmup": 30,
        "thin": 2,
    }
    with seeded(0):
        return denoise(y, **(settings | options))


# --- the noise ---


def test_the_share_of_large_errors_is_that_of_the_slab_beyond() -> None:
    noise = MODEL.sample_like(torch.empty(200_000))
    for size in (0.1, 1.0, 10.0):
        expected = 0.5 * (1 - 2 / math.pi * math.atan(size / 0.25))
        share = float((noise.abs() > size).float().mean())
        assert abs(share - expected) < 4 * (expected / len(noise)) ** 0.5


def test_noise_never_exceeds_the_bound_and_reaches_it() -> None:
    noise = SpikeAndSlab(slab_scale=100.0).sample_like(torch.empty(10_000))
    assert float(noise.max()) == 1000.0
    assert float(noise.min()) == -1000.0


def test_the_density_is_the_mixture_of_both_laws() -> None:
    for share in [0.0, 0.3, 1.0]:
        model = SpikeAndSlab(spike_std=0.1, slab_scale=0.5, slab_probability=share)
        noise = torch.linspace(-3, 3, 101, dtype=torch.float64)
        zero = torch.zeros((), dtype=torch.float64)
        spike = Normal(zero, zero + 0.1).log_prob(noise).exp()
        slab = Cauchy(zero, zero + 0.5).log_prob(noise).exp()
        expected = (1 - share) * spike + share * slab
        assert torch.allclose(model.log_prob(noise).exp(), expected, rtol=1e-6)


# --- denoising ---


def quadrature(y: float) -> tuple[float, float, float]:
    """Mean, sd and the mass of the spike of p(s | y) with a standard normal q(s)."""
    s = torch.cat(
        [torch.linspace(-9, 9, 100_001), torch.linspace(y - 0.1, y + 0.1, 9999)]
    )
    s = s.double().sort().values
    density = (standard_normal(s[:, None]) + MODEL.log_prob(y - s)).double()
    density = (density - density.max()).exp()
    density = density / torch.trapezoid(density, s)
    mean = torch.trapezoid(density * s, s)
    variance = torch.trapezoid(density * (s - mean) ** 2, s)
    spike = torch.trapezoid(density * ((s - y).abs() < 0.05), s)
    return float(mean), float(variance) ** 0.5, float(spike)


@pytest.mark.slow
def test_denoised_draws_have_the_moments_found_by_quadrature() -> None:
    # At 3 spike and slab compete; at 1000 q(s) alone is left.
    values = [0.0, 1.0, 3.0, 5.0, 1000.0]
    draws, r_hat = denoised(torch.tensor(values)[:, None])
    assert draws.shape == (5, 1000, 1)
    assert (r_hat < 1.1).all()
    for y, s in zip(values, draws[..., 0], strict=True):
        mean, std, spike = quadrature(y)
        assert float(s.mean()) == pytest.approx(mean, abs=0.12)
        assert float(s.std()) == pytest.approx(std, abs=0.08)
        share = float(((s - y).abs() < 0.05).float().mean())
        assert share == pytest.approx(spike, abs=0.05)


@pytest.mark.medium
def test_with_gaussian_errors_denoising_is_the_kalman_update() -> None:
    covariance = torch.tensor([[1.0, 0.8], [0.8, 1.0]])
    q = MultivariateNormal(torch.zeros(2), covariance)
    y = torch.tensor([[1.0, -1.0], [2.0, 0.5]])
    model = SpikeAndSlab(spike_std=0.5, slab_probability=0.0)
    simulated = q.sample(torch.Size((500,)))
    draws, _ = denoised(
        y, log_density=q.log_prob, simulated=simulated, error_model=model
    )
    gain = covariance @ torch.linalg.inv(covariance + 0.25 * torch.eye(2))
    posterior = covariance - gain @ covariance
    for observation, s in zip(y, draws, strict=True):
        assert torch.allclose(s.mean(dim=0), gain @ observation, atol=0.06)
        assert torch.allclose(torch.cov(s.T), posterior, atol=0.04)


# --- convergence ---


def test_r_hat_is_the_textbook_ratio_of_variances() -> None:
    draws = torch.randn(3, 4, 10, 2, dtype=torch.float64)
    result = split_r_hat(draws)
    for i, d in np.ndindex(3, 2):
        chains = draws[i, :, :, d].numpy().reshape(8, 5)
        within = chains.var(axis=1, ddof=1).mean()
        between = 5 * chains.mean(axis=1).var(ddof=1)
        expected = np.sqrt((4 / 5 * within + between / 5) / within)
        assert float(result[i, d]) == pytest.approx(expected)
    drifting = torch.randn(4, 1000, 1) + torch.linspace(0, 5, 1000)[:, None]
    assert float(split_r_hat(drifting)) > 1.3
