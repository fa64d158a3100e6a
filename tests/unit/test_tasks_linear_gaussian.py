"""The task whose posteriors are known."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_rope.tasks.linear_gaussian import LinearGaussian, LinearGaussianSimulator


def test_real_observations_are_scaled_and_shifted_simulations() -> None:
    theta, noise = torch.randn(20, 4), torch.randn(20, 4)
    x_s = LinearGaussianSimulator(dim=4).observe(theta, noise)
    real = LinearGaussianSimulator(dim=4, scale=-2.0, shift=3.0)
    torch.testing.assert_close(real.observe(theta, noise), -2.0 * x_s + 3.0)


@pytest.mark.parametrize("dim", [1, 25])
def test_true_posterior_is_that_of_the_joint_gaussian(dim: int) -> None:
    # Conditioning the joint law of (theta, x), by Schur complements.
    real = LinearGaussianSimulator(dim=dim, scale=1.7, shift=-0.4, noise_std=0.3)
    x = torch.randn(5, dim, dtype=torch.float64)
    matrix = real.scale * real.matrix(x)
    cov_x = matrix @ matrix.T + (real.scale * real.noise_std) ** 2 * torch.eye(dim)
    gain = torch.linalg.solve(cov_x, matrix).T
    expected = MultivariateNormal(
        (x - real.shift) @ gain.T,
        torch.eye(dim, dtype=torch.float64) - gain @ matrix,
    )
    posterior = real.posterior(x)
    torch.testing.assert_close(posterior.mean, expected.mean)
    torch.testing.assert_close(
        posterior.covariance_matrix, expected.covariance_matrix.expand(5, -1, -1)
    )


def test_true_posterior_is_calibrated_on_the_real_process() -> None:
    task = LinearGaussian(dim=3)
    theta, x_o = task.get_test_set(4000)
    posterior = task.get_true_posterior(x_o)
    levels = torch.special.ndtr((theta - posterior.mean) / posterior.stddev)
    steps = torch.arange(1, 4001).unsqueeze(1) / 4000
    # Kolmogorov's distance of uniform draws.
    assert (levels.sort(dim=0).values - steps).abs().max() < 2.2 / 4000**0.5


def test_a_curved_error_gives_two_parameters_the_same_observation() -> None:
    task = LinearGaussian(variant="curved", noise_std=1e-6, dim=1)
    theta, x = task.get_test_set(500)
    expected = 1.4 * theta + 0.7 + 0.5 * theta**2
    torch.testing.assert_close(x, expected, atol=1e-4, rtol=0)
    # The parabola turns at -1.4.
    assert (theta < -1.4).any()


def test_parameters_observations_and_networks_have_the_dimension_asked_for() -> None:
    task = LinearGaussian(dim=25)
    assert task.theta_dim == len(task.parameter_units) == len(task.x_names) == 25
    theta, x_o = task.get_calibration_set(3)
    assert theta.shape == x_o.shape == (3, 25)
    assert task.get_embedding_net()(x_o).shape == (3, 50)
