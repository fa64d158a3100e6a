"""Bounds of priors, and densities on a bound."""

import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch.distributions import Beta, Categorical, Gamma, Uniform

from sbi_rope._prior import bounds_of, off_bounds, prior_log_prob

ONE = torch.ones(1)


def test_a_batch_has_the_bounds_of_each_parameter_in_every_row() -> None:
    prior = MultipleIndependent([Gamma(2 * ONE, ONE), Beta(2 * ONE, 2 * ONE)])
    for shape in ((2,), (2, 2), (3, 2), (4, 3, 2)):
        low, high = bounds_of(prior, torch.zeros(shape))
        assert torch.equal(low, torch.zeros(shape))
        assert torch.equal(high, torch.tensor([torch.inf, 1.0]).expand(shape))


def test_discrete_parameters_are_not_moved_off_their_bounds() -> None:
    prior = MultipleIndependent(
        [Uniform(-ONE, ONE), Categorical(probs=torch.ones(1, 3))], validate_args=False
    )
    theta = torch.tensor([[1.0, 0.0], [-1.0, 2.0], [0.5, 1.0]])
    moved = off_bounds(prior, theta)
    assert torch.equal(moved[:, 1], theta[:, 1])
    assert (moved[:2, 0].abs() < 1).all()
    assert moved[2, 0] == 0.5


def test_the_density_on_a_bound_is_that_just_inside() -> None:
    box = BoxUniform(-torch.ones(2), torch.ones(2))
    corners = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0], [0.0, 1.1]])
    expected = torch.tensor([0.25, 0.25, 0.25, 0.0]).log()
    assert torch.allclose(prior_log_prob(box, corners), expected)
    arcsine = MultipleIndependent([Beta(0.5 * ONE, 0.5 * ONE)] * 2)
    assert prior_log_prob(arcsine, torch.zeros(1, 2)).isfinite().all()
