"""The uniform law on a triangle."""

import pickle

import pytest
import torch
from sbi.utils import mcmc_transform, within_support
from scipy.stats import ks_2samp, kstest
from torch.autograd.functional import jacobian
from torch.distributions import biject_to

from sbi_rope.tasks.triangle import UniformTriangle


@pytest.fixture
def triangle() -> UniformTriangle:
    return UniformTriangle(torch.tensor(0.5), validate_args=False)


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


def test_moments_of_the_triangle_are_those_of_draws(triangle: UniformTriangle) -> None:
    draws = triangle.sample((50_000,))
    torch.testing.assert_close(draws.mean(dim=0), triangle.mean, rtol=0.02, atol=0.0)
    torch.testing.assert_close(draws.std(dim=0), triangle.stddev, rtol=0.02, atol=0.0)


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


def test_sbi_keeps_one_log_determinant_a_row_of_the_triangle(
    triangle: UniformTriangle,
) -> None:
    to_unconstrained = mcmc_transform(triangle)
    theta = triangle.sample((7,))
    z = to_unconstrained(theta)
    assert to_unconstrained.log_abs_det_jacobian(theta, z).shape == (7,)
    torch.testing.assert_close(to_unconstrained.inv(z), theta)


def test_triangle_can_be_copied_expanded_and_moved(triangle: UniformTriangle) -> None:
    copied = pickle.loads(pickle.dumps(triangle))
    draws = copied.sample((5,))
    assert draws.dtype == torch.float32
    torch.testing.assert_close(copied.log_prob(draws), triangle.log_prob(draws))
    assert pickle.loads(pickle.dumps(triangle.support)).check(draws).all()
    expanded = triangle.expand((3,))
    assert (expanded.batch_shape, expanded.event_shape) == ((3,), (2,))
    assert expanded.sample((4,)).shape == (4, 3, 2)
    assert expanded.mean.shape == expanded.variance.shape == (3, 2)
    assert expanded.log_prob(draws[:3]).shape == (3,)
    copied.to("meta")
    assert copied.sample().device.type == copied.mean.device.type == "meta"
