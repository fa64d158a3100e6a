"""Distributions that priors need."""

import pytest
import torch
from sbi.utils import within_support
from scipy.stats import ks_2samp, kstest
from torch.autograd.functional import jacobian
from torch.distributions import Beta, biject_to

from sbi_rope.tasks.distributions import Arcsine, UniformDistance, UniformTriangle, box

Law = type[UniformDistance] | type[Arcsine]
LAWS = pytest.mark.parametrize("law", [UniformDistance, Arcsine])


# Both laws ---------------------------------------------------------------------------


@LAWS
def test_the_density_is_the_derivative_of_the_distribution_function(law: Law) -> None:
    some = law(torch.tensor([40.0], dtype=torch.float64))
    d = torch.linspace(0.5, 39.5, 20, dtype=torch.float64, requires_grad=True)
    (density,) = torch.autograd.grad(some.cdf(d).sum(), d)
    torch.testing.assert_close(density, some.log_prob(d).exp())


# Arcsine -----------------------------------------------------------------------------


@pytest.fixture
def malus() -> Arcsine:
    return Arcsine(torch.tensor([1.0]))


def test_arcsine_is_a_beta_of_one_half() -> None:
    alpha = torch.linspace(0.001, 0.999, 99, dtype=torch.float64)
    half = torch.tensor(0.5, dtype=torch.float64)
    beta, malus = Beta(half, half), Arcsine(torch.ones(1, dtype=torch.float64))
    torch.testing.assert_close(malus.log_prob(alpha), beta.log_prob(alpha))
    torch.testing.assert_close(malus.mean, beta.mean.reshape(1))
    torch.testing.assert_close(malus.variance, beta.variance.reshape(1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_arcsine_density_is_finite_at_its_ends_and_zero_beyond(
    dtype: torch.dtype,
) -> None:
    malus = Arcsine(torch.ones(1, dtype=dtype))
    ends = torch.tensor([0.0, 1e-40, 1.0, 1 - 6e-8], dtype=dtype)
    torch.testing.assert_close(
        malus.log_prob(ends), malus.log_prob(torch.tensor(2.0**-23)).expand(4).to(dtype)
    )
    beyond = torch.tensor([-1e-6, 1 + 2e-7, 2.0], dtype=dtype)
    assert (malus.log_prob(beyond) == -torch.inf).all()
    assert malus.support.check(ends).all()
    assert not malus.support.check(beyond).any()


# Boxes -------------------------------------------------------------------------------


def test_closed_box_has_a_density_at_its_upper_end_and_not_beyond() -> None:
    ends = torch.tensor([[45.0], [45.001]])
    log_prob = box((0.0,), (45.0,), closed=True).log_prob(ends)
    assert log_prob[0].exp() == pytest.approx(1 / 45)
    assert log_prob[1] == -torch.inf
    assert box((0.0,), (45.0,)).log_prob(ends)[0] == -torch.inf


# The triangle ------------------------------------------------------------------------


@pytest.fixture
def triangle() -> UniformTriangle:
    return UniformTriangle(torch.tensor(0.5))


def test_triangle_has_density_eight_inside_and_zero_outside(
    triangle: UniformTriangle,
) -> None:
    values = torch.tensor(
        [
            [[0.4, 0.1], [0.5, 0.5], [0.0, 0.0]],
            [[0.1, 0.2], [0.51, 0.1], [0.3, -0.1]],
        ]
    )
    expected = torch.tensor([[8.0, 8.0, 8.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(triangle.log_prob(values).exp(), expected)
    assert torch.equal(triangle.support.check(values), expected > 0)
    assert torch.equal(within_support(triangle, values[0]), torch.tensor([True] * 3))
    assert triangle.log_prob(values[0, 0]).shape == ()


def test_triangle_is_filled_uniformly(triangle: UniformTriangle) -> None:
    draws = triangle.sample((40_000,))
    # Half of the points of the square are reflected into the triangle.
    square = 0.5 * torch.rand(40_000, 2)
    expected = square.sort(dim=1, descending=True).values
    for column, reference in zip(draws.T, expected.T, strict=True):
        assert ks_2samp(column, reference).pvalue > 1e-3
    ratio = draws[:, 1] / draws[:, 0]
    assert kstest(ratio, "uniform").pvalue > 1e-3
    assert torch.corrcoef(torch.stack([ratio, draws[:, 0]]))[0, 1].abs() < 0.02


def test_triangle_bijection_has_the_log_determinant_of_its_jacobian(
    triangle: UniformTriangle,
) -> None:
    transform = biject_to(UniformTriangle(torch.tensor(0.5).double()).support)
    z = 2 * torch.randn(20, 2, dtype=torch.float64)
    theta = transform(z)
    assert triangle.support.check(theta).all()
    jacobians = torch.stack([jacobian(transform, row) for row in z])
    expected = jacobians.det().abs().log()
    torch.testing.assert_close(transform.log_abs_det_jacobian(z, theta), expected)
    torch.testing.assert_close(transform.inv(theta), z)


def test_triangle_bijection_is_finite_on_the_edges(triangle: UniformTriangle) -> None:
    transform = biject_to(triangle.support)
    edges = torch.tensor([[0.0, 0.0], [0.5, 0.5], [0.5, 0.0], [0.2, 0.2]])
    z = transform.inv(edges)
    assert z.isfinite().all()
    torch.testing.assert_close(transform(z), edges)
    far = transform(torch.tensor([[200.0, -200.0], [-200.0, 200.0]]))
    assert triangle.support.check(far).all()
