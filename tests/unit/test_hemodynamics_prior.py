"""The density of stroke volume and ejection time."""

import numpy as np
import pytest
import torch
from scipy.stats import kstest, norm
from torch import Tensor
from torch.autograd.functional import jacobian
from torch.distributions import biject_to

from sbi_rope.tasks.hemodynamics import population_tables as tables
from sbi_rope.tasks.hemodynamics.population import Population, ejection_time_slopes
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior

N = 8000


@pytest.fixture
def prior() -> PopulationPrior:
    return PopulationPrior()


def _grid(prior: PopulationPrior, points: int = 801) -> tuple[Tensor, float]:
    """Return midpoints of a grid over all parameters, and the area of a cell."""
    low, high = torch.tensor([25.0, 150.0]), torch.tensor([105.0, 400.0])
    places = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    axes = [a + (b - a) * places for a, b in zip(low, high, strict=True)]
    area = float((high - low).prod()) / points**2
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1), area


@pytest.mark.slow
def test_people_follow_the_density_and_its_moments(prior: PopulationPrior) -> None:
    hearts = [Population().draw("simulator", 5, i) for i in range(N)]
    theta = torch.tensor([(s.stroke_volume, s.ejection_time) for s in hearts])
    assert prior.support.check(theta).all()
    assert prior.log_prob(theta).isfinite().all()
    for probabilities in prior.marginal_cdf(theta).T:
        assert kstest(probabilities, "uniform").pvalue > 1e-3
    # Two dimensions: cells of a histogram, against sums of the density over them.
    edges = [np.linspace(25, 105, 13), np.linspace(200, 365, 13)]
    counts = np.histogram2d(*theta.numpy().T, bins=edges)[0].ravel()
    grid, area = _grid(prior)
    mass = prior.log_prob(grid).exp().flatten() * area
    points = grid.reshape(-1, 2).numpy()
    expected = N * np.histogram2d(*points.T, bins=edges, weights=mass)[0].ravel()
    large = expected > 8
    chi_squared = ((counts - expected)[large] ** 2 / expected[large]).sum()
    assert chi_squared < large.sum() + 4 * (2 * large.sum()) ** 0.5
    assert large.sum() > 30
    torch.testing.assert_close(prior.mean, theta.mean(dim=0), rtol=0.01, atol=0.0)
    torch.testing.assert_close(prior.stddev, theta.std(dim=0), rtol=0.03, atol=0.0)
    assert prior.mean.dtype == prior.variance.dtype == torch.float32


def test_draws_follow_the_density(prior: PopulationPrior) -> None:
    draws = prior.sample((50_000,))
    assert draws.dtype == torch.float32
    assert prior.support.check(draws).all()
    assert prior.log_prob(draws).isfinite().all()
    for probabilities in prior.marginal_cdf(draws).T:
        assert kstest(probabilities, "uniform").pvalue > 1e-3
    grid, area = _grid(prior)
    density = prior.log_prob(grid).exp()
    mean = (density.unsqueeze(-1) * grid).sum(dim=(0, 1)) * area
    centred = grid - mean
    covariance = float((density * centred.prod(dim=-1)).sum() * area)
    found = float(torch.cov(draws.double().T)[0, 1])
    assert found == pytest.approx(covariance, abs=5.0)
    assert float(draws[:, 0].mean()) == pytest.approx(float(mean[0]), abs=0.25)


def _cut_normal(
    value: np.ndarray | float, mean: np.ndarray | float, sd: np.ndarray | float
) -> np.ndarray:
    inside = np.abs(value - np.asarray(mean)) <= 2 * np.asarray(sd)
    return np.where(inside, norm.pdf(value, mean, sd) / 0.9544997361, 0.0)


def test_density_is_the_integral_over_age_and_heart_rate() -> None:
    start, slope, noise_sd = ejection_time_slopes()
    age = 25 + 50 * (np.arange(2000) + 0.5) / 2000
    rate = (50 + 52 * (np.arange(2000) + 0.5) / 2000)[:, None]
    mean, sd = tables.stroke_volume_law(age)
    law_of_rate = _cut_normal(rate, tables.heart_rate_mean(age), tables.HEART_RATE_SD)
    for volume, time in ((60.0, 280.0), (75.0, 310.0), (40.0, 262.0)):
        predicted = start + slope * tables.weissler_time(volume, rate)
        joint = (
            _cut_normal(volume, mean, sd)
            * law_of_rate
            * _cut_normal(time, predicted, noise_sd)
        )
        expected = joint.mean() * 52  # ages have the density 1 / 50
        found = PopulationPrior().log_prob(torch.tensor([volume, time])).exp()
        assert float(found) == pytest.approx(expected, rel=5e-3)


def test_the_density_integrates_to_the_marginal_cdf_and_to_one(
    prior: PopulationPrior,
) -> None:
    grid, area = _grid(prior)
    mass = prior.log_prob(grid).exp() * area
    assert float(mass.sum()) == pytest.approx(1, abs=2e-3)
    for row in (150, 350, 500):
        theta = grid[row, row].float().unsqueeze(0)
        below = [mass[:row].sum() + mass[row].sum() / 2]
        below.append(mass[:, :row].sum() + mass[:, row].sum() / 2)
        expected = torch.stack(below)[None].float()
        found = prior.marginal_cdf(theta)
        torch.testing.assert_close(found, expected, rtol=0.0, atol=2e-3)
    far = torch.tensor([[0.0, 0.0], [1000.0, 1000.0]])
    assert prior.marginal_cdf(far).tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_bijection_has_the_log_determinant_of_its_jacobian(
    prior: PopulationPrior,
) -> None:
    transform = biject_to(prior.support)
    z = 2 * torch.randn(10, 2, dtype=torch.float64)
    theta = transform(z)
    assert prior.support.check(theta).all()
    expected = torch.stack([jacobian(transform, row) for row in z]).det().abs().log()
    torch.testing.assert_close(transform.log_abs_det_jacobian(z, theta), expected)
    torch.testing.assert_close(transform.inv(theta), z)
    far = transform(torch.tensor([[200.0, -200.0], [-200.0, 200.0], [200.0, 200.0]]))
    assert prior.support.check(far).all()
    assert transform.inv(far).isfinite().all()
