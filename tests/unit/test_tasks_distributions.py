"""The distance of two uniform draws."""

import pytest
import torch
from torch.distributions import Beta, biject_to

from sbi_rope.tasks.distributions import UniformDistance


@pytest.fixture
def distance() -> UniformDistance:
    return UniformDistance(torch.tensor([40.0]), validate_args=False)


def test_density_is_that_of_a_scaled_beta(distance: UniformDistance) -> None:
    d = torch.linspace(0.1, 39.9, 50)
    beta = Beta(torch.tensor(1.0), torch.tensor(2.0))
    expected = beta.log_prob(d / 40) - torch.tensor(40.0).log()
    torch.testing.assert_close(distance.log_prob(d), expected)


def test_density_is_the_derivative_of_the_distribution_function() -> None:
    distance = UniformDistance(torch.tensor([40.0], dtype=torch.float64))
    d = torch.linspace(0.5, 39.5, 20, dtype=torch.float64, requires_grad=True)
    (density,) = torch.autograd.grad(distance.cdf(d).sum(), d)
    torch.testing.assert_close(density, distance.log_prob(d).exp())


def test_density_at_the_ends(distance: UniformDistance) -> None:
    values = torch.tensor([-1e-3, 0.0, 40.0, 40.1])
    expected = torch.tensor([0.0, 0.05, 0.0, 0.0])
    torch.testing.assert_close(distance.log_prob(values).exp(), expected)
    assert distance.support.check(values).tolist() == [False, True, True, False]


def test_draws_are_distances_of_uniform_draws(distance: UniformDistance) -> None:
    draws = distance.sample((20_000,)).flatten()
    uniform = 40 * torch.rand(2, 20_000) - 15
    levels = torch.linspace(0.01, 0.99, 50)
    torch.testing.assert_close(
        draws.quantile(levels),
        (uniform[0] - uniform[1]).abs().quantile(levels),
        atol=0.6,
        rtol=0.0,
    )


def test_quantile_function_inverts_the_distribution_function(
    distance: UniformDistance,
) -> None:
    level = torch.tensor([0.0, 1e-6, 0.3, 0.999, 1.0])
    torch.testing.assert_close(distance.cdf(distance.icdf(level)), level)
    assert distance.icdf(level[[0, -1]]).tolist() == [0.0, 40.0]


def test_mean_and_standard_deviation_are_those_of_draws(
    distance: UniformDistance,
) -> None:
    draws = distance.sample((50_000,))
    torch.testing.assert_close(draws.mean(dim=0), distance.mean, rtol=0.02, atol=0.0)
    torch.testing.assert_close(draws.std(dim=0), distance.stddev, rtol=0.02, atol=0.0)


def test_draws_are_differentiable_in_the_width() -> None:
    width = torch.tensor([2.0], requires_grad=True)
    draws = UniformDistance(width).rsample((100,))
    draws.sum().backward()
    assert width.grad is not None
    torch.testing.assert_close(width.grad, draws.detach().sum(dim=0) / 2)


def test_values_outside_raise_when_arguments_are_validated() -> None:
    distance = UniformDistance(torch.tensor([1.0]), validate_args=True)
    with pytest.raises(ValueError, match="support"):
        distance.log_prob(torch.tensor([2.0]))
    with pytest.raises(ValueError, match="width"):
        UniformDistance(torch.tensor([-1.0]), validate_args=True)


def test_support_has_a_bijection_from_the_real_line(distance: UniformDistance) -> None:
    constrained = biject_to(distance.support)(torch.tensor([-2.0, 0.0, 2.0]))
    assert distance.support.check(constrained).all()
    assert constrained[1] == 20.0


def test_expanding_repeats_the_width(distance: UniformDistance) -> None:
    expanded = distance.expand((3,))
    assert expanded.batch_shape == (3,)
    assert expanded.sample((2,)).shape == (2, 3)
