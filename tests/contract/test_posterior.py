"""MixturePosterior keeps the contract of sbi's posteriors, and adds a batch to it."""

import itertools

import numpy as np
import pytest
import torch
from sbi.inference import EnsemblePosterior
from sbi.utils import BoxUniform
from torch.distributions import Exponential, Independent, Normal

from sbi_rope.density import PriorPosterior
from tests.problems import gaussian_posterior

QUIET = {"show_progress_bars": False}


POSTERIORS = (
    gaussian_posterior,
    lambda: gaussian_posterior(x_o=torch.randn(5, 1, 8, 8)),  # images
    lambda: gaussian_posterior(x_o=torch.randn(5, 1), dim=1),
)


def test_sample_has_the_shape_asked_for() -> None:
    for make, shape in itertools.product(POSTERIORS, ((), (1,), (4,), (2, 3))):
        posterior = make()
        dim = posterior.posterior_estimator.input_shape[0]
        x_o = posterior.x_o
        for x in (x_o[1], x_o[1:2]):
            samples = posterior.sample(shape, x=x, **QUIET)
            assert samples.shape == (*shape, dim)
        for size in (1, 3, 5):
            samples = posterior.sample_batched(shape, x_o[:size], **QUIET)
            assert samples.shape == (*shape, size, dim)
        assert samples.dtype is torch.float32
        assert not samples.requires_grad
    assert gaussian_posterior()[2].sample(**QUIET).shape == (2,)


def test_log_prob_has_the_shapes_of_sbi() -> None:
    for make in POSTERIORS:
        posterior = make()
        dim = posterior.posterior_estimator.input_shape[0]
        x_o = posterior.x_o
        theta = 2 * torch.rand(7, 5, dim) - 1
        for x in (x_o[0], x_o[:1]):
            assert posterior.log_prob(theta[:, 0], x=x).shape == (7,)
            assert posterior.log_prob(theta[0, 0], x=x).shape == (1,)
        assert posterior.log_prob_batched(theta[0], x_o).shape == (1, 5)
        batched = posterior.log_prob_batched(theta, x_o)
        assert batched.shape == (7, 5)
        assert batched.dtype is torch.float32
        for i in range(5):
            single = posterior.log_prob(theta[:, i], x=x_o[i])
            assert torch.allclose(single, batched[:, i], atol=1e-5)


def test_theta_on_a_bound_of_the_prior_is_inside_in_every_form() -> None:
    # 0.1 and 0.7 of float64 are outside of a prior that has them as float32.
    prior = BoxUniform(torch.tensor([0.1, 0.1]), torch.tensor([0.7, 0.7]))
    posterior = gaussian_posterior(prior=prior)
    x = posterior.x_o
    flat = PriorPosterior(prior)
    for corner in ([0.1, 0.7], [0.7, 0.1]):
        expected = posterior.log_prob(torch.tensor([corner]), x=x[0])
        assert torch.isfinite(expected).all()
        for theta in (np.array([corner]), torch.tensor([corner]).double(), [corner]):
            assert torch.equal(posterior.log_prob(theta, x=x[0]), expected)
            batched = posterior.log_prob_batched(theta, x[:1])
            assert torch.allclose(batched, expected, atol=1e-5)
            assert torch.isfinite(flat.log_prob(theta)).all()


def test_the_potential_is_the_log_prob_without_normalisation() -> None:
    posterior = gaussian_posterior(tail_mass=1e-3)
    theta = 3 * torch.rand(9, 2) - 1.5
    x = posterior.x_o[1]
    expected = posterior.log_prob(theta, x=x, norm_posterior=False)
    assert torch.allclose(posterior.potential(theta, x=x), expected, atol=1e-6)
    assert torch.allclose(posterior[1].potential(theta), expected, atol=1e-6)


def test_gradients_of_potential_and_log_prob_are_those_of_finite_differences() -> None:
    posterior = gaussian_posterior(tail_mass=1e-3)
    theta = (torch.rand(4, 2) - 0.5).requires_grad_()
    x, step = posterior.x_o[2], 1e-2
    for function in (
        lambda t: posterior.potential(t, x=x, track_gradients=True),
        lambda t: posterior.log_prob(t, x=x, track_gradients=True),
    ):
        (gradient,) = torch.autograd.grad(function(theta).sum(), theta)
        for k in range(2):
            shift = step * torch.eye(2)[k]
            change = (function(theta + shift) - function(theta - shift)) / (2 * step)
            assert torch.allclose(gradient[:, k], change, atol=0.02, rtol=0.02)


@pytest.mark.medium
def test_map_finds_the_mode() -> None:
    posterior = gaussian_posterior()
    axis = torch.linspace(-0.99, 0.99, 150)
    grid = torch.cartesian_prod(axis, axis)
    for i in (0, 3):
        view = posterior[i]
        best = view.log_prob(grid).max()
        mode = view.map(num_iter=100, num_init_samples=200, show_progress_bars=False)
        assert mode.shape == (1, 2)
        assert view.log_prob(mode) > best - 0.02


def test_an_ensemble_of_sbi_averages_posteriors() -> None:
    members = [gaussian_posterior(x_o=torch.ones(5, 3)) for _ in range(2)]
    weights, x = torch.tensor([0.7, 0.3]), torch.ones(1, 3)
    ensemble, theta = EnsemblePosterior(members, weights.tolist()), torch.ones(1, 2) / 5
    each = torch.stack([member.log_prob(theta, x=x) for member in members])
    expected = (each + weights.log()[:, None]).logsumexp(dim=0)
    assert torch.allclose(ensemble.log_prob(theta, x=x), expected, atol=1e-5)
    assert ensemble.sample((7,), x=x, **QUIET).shape == (7, 2)


# --- the prior as a posterior ---


def test_the_prior_ignores_x_and_has_its_own_density() -> None:
    normal = Independent(Normal(torch.tensor([1.0, -2.0]), torch.tensor([0.5, 2.0])), 1)
    samples = PriorPosterior(normal).sample_batched((4000,), torch.full((2, 1), 1e6))
    assert torch.allclose(samples.mean(dim=0), normal.mean.expand(2, 2), atol=0.2)
    assert torch.allclose(samples.std(dim=0), normal.stddev.expand(2, 2), rtol=0.1)
    # Unlike sbi's own priors, this one raises outside its support.
    law = Exponential(torch.ones(2), validate_args=True)
    positive = Independent(law, 1, validate_args=True)
    theta, posterior = positive.sample((6,)), PriorPosterior(positive)
    expected = positive.log_prob(theta)
    assert torch.equal(posterior.log_prob(theta), expected)
    batched = posterior.log_prob_batched(theta, torch.zeros(6, 1))
    assert torch.equal(batched[0], expected)
    assert posterior.log_prob(torch.tensor([[-0.5, 0.5]])) == -torch.inf
