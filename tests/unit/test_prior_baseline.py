"""The prior is a posterior that ignores x."""

import math
import pickle

import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Size, Tensor
from torch.distributions import (
    Distribution,
    Exponential,
    Independent,
    Normal,
    constraints,
)

from sbi_rope.baselines import PriorBaseline, PriorPosterior


def box() -> Distribution:
    return BoxUniform(torch.tensor([0.0, -1.0]), torch.tensor([2.0, 1.0]))


def normal() -> Distribution:
    return Independent(Normal(torch.tensor([1.0, -2.0]), torch.tensor([0.5, 2.0])), 1)


def positive() -> Distribution:
    # Unlike sbi's own priors, this one raises outside its support.
    law = Exponential(torch.ones(2), validate_args=True)
    return Independent(law, 1, validate_args=True)


class Disc(constraints.Constraint):
    """The unit disc, to which torch has no bijection."""

    event_dim = 1

    def check(self, value: Tensor) -> Tensor:
        return value.norm(dim=-1) < 1


class OnDisc(Distribution):
    """Uniform over the unit disc."""

    arg_constraints = {}  # noqa: RUF012
    support = Disc()

    def __init__(self) -> None:
        super().__init__(event_shape=Size((2,)), validate_args=False)

    def sample(self, sample_shape: Size = Size()) -> Tensor:  # noqa: B008
        radius = torch.rand(*sample_shape, 1).sqrt()
        return radius * torch.nn.functional.normalize(torch.randn(*sample_shape, 2))

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.full(value.shape[:-1], -math.log(math.pi))


def test_samples_follow_the_prior_whatever_x() -> None:
    samples = PriorPosterior(normal()).sample_batched((4000,), torch.full((2, 1), 1e6))
    assert torch.allclose(samples.mean(dim=0), normal().mean.expand(2, 2), atol=0.2)
    assert torch.allclose(samples.std(dim=0), normal().stddev.expand(2, 2), rtol=0.1)


def test_log_prob_is_the_prior_density() -> None:
    for prior in [box(), positive()]:
        theta = prior.sample((6,))
        posterior = PriorPosterior(prior)
        expected = prior.log_prob(theta)
        assert torch.equal(posterior.log_prob(theta), expected)
        batched = posterior.log_prob_batched(theta, torch.zeros(6, 1))
        assert torch.equal(batched, expected.unsqueeze(0))
        outside = torch.tensor([[-0.5, 0.5]])
        assert torch.isneginf(posterior.log_prob(outside)).all()


def test_a_prior_of_independent_parts_can_be_drawn_and_evaluated_in_batches() -> None:
    prior = MultipleIndependent(
        [BoxUniform(torch.zeros(2), 2 * torch.ones(2)), Normal(torch.zeros(1), 1.0)]
    )
    posterior = PriorPosterior(prior)
    x = torch.zeros(3, 5)
    theta = posterior.sample_batched((2, 4), x)
    assert theta.shape == (2, 4, 3, 3)
    assert posterior.sample((2, 4)).shape == (2, 4, 3)
    expected = Normal(0.0, 1.0).log_prob(theta[0, ..., 2]) - math.log(4)
    assert torch.allclose(posterior.log_prob_batched(theta[0], x), expected)


def test_a_prior_that_sbi_cannot_transform_can_be_drawn_and_evaluated() -> None:
    prior = OnDisc()
    posterior = PriorBaseline(prior).train().build_posterior()
    posterior = pickle.loads(pickle.dumps(posterior))
    theta = posterior.sample_batched((4,), torch.zeros(3, 5))
    assert theta.shape == (4, 3, 2)
    values = posterior.log_prob_batched(theta, torch.zeros(3, 5))
    assert torch.allclose(values, prior.log_prob(theta))
    assert posterior.log_prob(torch.ones(1, 2)) == -torch.inf
