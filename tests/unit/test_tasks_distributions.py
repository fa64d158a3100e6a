"""Distributions that priors need."""

import pytest
import torch
from scipy.stats import kstest
from torch.autograd.functional import jacobian
from torch.distributions import biject_to

from sbi_rope.tasks.distributions import Arcsine, UniformTriangle
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_arcsine_density_is_finite_at_its_ends_and_zero_beyond(
    dtype: torch.dtype,
) -> None:
    malus = Arcsine(torch.ones(1, dtype=dtype))
    ends = torch.tensor([0.0, 1e-40, 1.0, 1 - 6e-8], dtype=dtype)
    nearest = malus.log_prob(torch.tensor(2.0**-23)).expand(4).to(dtype)
    torch.testing.assert_close(malus.log_prob(ends), nearest)
    beyond = torch.tensor([-1e-6, 1 + 2e-7, 2.0], dtype=dtype)
    assert (malus.log_prob(beyond) == -torch.inf).all()


def test_a_triangle_is_filled_uniformly() -> None:
    draws = UniformTriangle(torch.tensor(0.5)).sample((40_000,))
    # Its area to the left of a place grows with the square, whatever the height there.
    ratio = draws[:, 1] / draws[:, 0]
    assert kstest((2 * draws[:, 0]) ** 2, "uniform").pvalue > 1e-3
    assert kstest(ratio, "uniform").pvalue > 1e-3
    assert torch.corrcoef(torch.stack([ratio, draws[:, 0]]))[0, 1].abs() < 0.02


@pytest.mark.parametrize(
    "prior",
    [UniformTriangle(torch.tensor(0.5).double()), PopulationPrior()],
    ids=["triangle", "population"],
)
def test_bijections_have_the_log_determinant_of_their_jacobian(
    prior: UniformTriangle | PopulationPrior,
) -> None:
    transform = biject_to(prior.support)
    z = 2 * torch.randn(20, 2, dtype=torch.float64)
    theta = transform(z)
    assert prior.support.check(theta).all()
    expected = torch.stack([jacobian(transform, row) for row in z]).det().abs().log()
    torch.testing.assert_close(transform.log_abs_det_jacobian(z, theta), expected)
    torch.testing.assert_close(transform.inv(theta), z)
    far = transform(torch.tensor([[200.0, -200.0], [-200.0, 200.0], [200.0, 200.0]]))
    assert prior.support.check(far).all()
    assert transform.inv(far).isfinite().all()


def test_the_bijection_of_the_triangle_is_finite_on_its_edges() -> None:
    transform = biject_to(UniformTriangle(torch.tensor(0.5)).support)
    edges = torch.tensor([[0.0, 0.0], [0.5, 0.5], [0.5, 0.0], [0.2, 0.2]])
    z = transform.inv(edges)
    assert z.isfinite().all()
    torch.testing.assert_close(transform(z), edges)
