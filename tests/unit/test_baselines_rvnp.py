"""RVNP: its densities are the stated ones, and it learns errors without labels."""

import functools
from typing import Any

import pytest
import torch
from sbi.neural_nets import likelihood_nn
from torch import Tensor, nn
from torch.distributions import (
    Categorical,
    Independent,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
)

from sbi_rope.baselines import RVNP
from sbi_rope.baselines.rvnp import (
    Bound,
    ErrorModel,
    fit_surrogate,
    gaussians_of,
    log_likelihood,
)
from sbi_rope.methods import Training
from sbi_rope.npe.sbi import estimator_of
from tests import gaussian
from tests.baselines import log_prob, train

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of epochs")
OF_SURROGATE = Training(training_batch_size=100, learning_rate=5e-3, max_num_epochs=8)


@functools.cache
def simulations() -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    theta = gaussian.prior().sample((2000,))
    return theta, gaussian.simulator(theta)


@functools.cache
def surrogate() -> Any:
    theta, x = simulations()
    torch.manual_seed(0)
    return fit_surrogate(theta, x, training=OF_SURROGATE, show_progress_bars=False)


# Densities.


def test_the_gaussians_of_a_mixture_density_network_have_its_density() -> None:
    theta, x = torch.randn(50, 2), torch.randn(50, 3)
    network = likelihood_nn("mdn", z_score_x="none", num_components=3)(theta, x)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.2)
    logits, means, covariances = gaussians_of(network, theta)
    correlated = covariances - torch.diag_embed(covariances.diagonal(dim1=-2, dim2=-1))
    assert correlated.abs().mean() > 0.1
    law = MixtureSameFamily(
        Categorical(logits=logits), MultivariateNormal(means, covariances)
    )
    expected = network.log_prob(x[None], theta)[0].double()
    torch.testing.assert_close(law.log_prob(x), expected, atol=0.02, rtol=0.01)


def test_the_likelihood_is_the_average_of_the_errors_over_simulations() -> None:
    errors = ErrorModel(simulations()[0], 2, shift=True, depends_on_theta=True)
    # Errors that vary with theta, as they may after training.
    for parameter in (errors.offset, errors.below, *errors.net[-1].parameters()):  # type: ignore[index,union-attr]
        nn.init.normal_(parameter, std=0.2)
    errors.requires_grad_(requires_grad=False)
    theta = torch.tensor([[0.4, -0.8]])
    s = surrogate().sample(torch.Size((100_000,)), theta)[:, 0]
    mean, _, covariance = errors(theta)
    # Not so far from the mean that few draws decide about the average.
    y = s.mean(dim=0) + mean + 0.5 * s.std(dim=0)
    found, of_mean = log_likelihood(surrogate(), errors, y, theta)
    assert of_mean.norm() > 0.1
    expected = MultivariateNormal(s + mean, covariance).log_prob(y).exp().mean().log()
    assert float(found[0]) == pytest.approx(float(expected), abs=0.02)


@pytest.mark.medium
def test_the_bound_is_the_evidence_and_its_weights_the_posterior_with_many_draws() -> (
    None
):
    """Of an untrained error model, with NPE in the place of q."""
    errors = ErrorModel(simulations()[0], 2, shift=True, depends_on_theta=False)
    q: Any = estimator_of(gaussian.posterior())
    bound = Bound(q, errors, surrogate(), gaussian.prior(), num_draws=20_000)
    y = torch.tensor([[0.5, -0.3], [2.5, 0.0]])
    steps = torch.linspace(-5, 5, 201)
    theta = torch.cartesian_prod(steps, steps)
    for row in y:
        log_lik, _ = log_likelihood(
            surrogate(), bound.errors, row.expand(len(theta), 2), theta
        )
        joint = log_lik + gaussian.prior().log_prob(theta)
        evidence = joint.logsumexp(dim=0) + 2 * torch.tensor(0.05).log()
        log_q = bound.q.log_prob(theta, row.expand(len(theta), 2))
        cross_entropy = -(joint.softmax(dim=0) * log_q).sum()
        found = bound(row[None], row[None])
        assert found[0].item() == pytest.approx(evidence.item(), abs=0.03)
        assert found[1].item() == pytest.approx(cross_entropy.item(), abs=0.03)


# Without labels.


def real(n: int, offset: float, extra_std: float) -> tuple[Tensor, Tensor]:
    """Parameters, and observations with an offset and more noise than simulations."""
    theta = gaussian.prior().sample((n,))
    x = gaussian.simulator(theta) + offset
    return theta, x + extra_std * torch.randn_like(x)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "extra_std", "shift", "least", "most"),
    [
        (0.7, 0.0, True, -0.01, 0.3),  # it undoes most of an offset
        (0.7, 0.7, True, -0.01, 0.3),  # and learns the noise
        (0.0, 0.0, True, -0.01, 0.25),  # and stays near NPE if the simulator is right
        (0.7, 0.0, False, 0.4, 5.0),  # without one in the errors it undoes none
    ],
)
def test_it_loses_few_nats_without_labels(
    offset: float, extra_std: float, shift: bool, least: float, most: float
) -> None:
    """Against the mean log density of the exact posterior."""
    training = Training(training_batch_size=50, learning_rate=2e-2, max_num_epochs=12)
    method = RVNP.from_posterior(
        gaussian.posterior(),
        noise_on="input",  # without its embedding, this NPE has no mean to be trained
        shift=shift,
        depends_on_theta=False,
        surrogate_training=OF_SURROGATE,
        training=training,
    )
    method.append_simulations(*simulations())
    torch.manual_seed(0)
    method.append_observations(real(600, offset, extra_std)[1])
    posterior = train(method).build_posterior()
    torch.manual_seed(1)
    theta, x = real(1000, offset, extra_std)
    variance = gaussian.NOISE_STD**2 + extra_std**2
    std = torch.tensor((variance / (1 + variance)) ** 0.5)
    exact = Independent(Normal((x - offset) / (1 + variance), std), 1).log_prob(theta)
    lost, lost_by_npe = (
        float((exact - log_prob(q, theta[None], x)[0]).mean())
        for q in (posterior, gaussian.posterior())
    )
    assert lost_by_npe > 1.0 or not offset
    assert least < lost < most
