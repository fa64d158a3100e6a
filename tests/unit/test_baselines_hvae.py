"""The HVAE: bound, gradients, networks, mixture and training."""

import math
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import Tensor, nn
from torch.distributions import Independent, MultivariateNormal, Normal

from sbi_rope.baselines import HVAE, PlainNPE
from sbi_rope.baselines.hvae import OverLatents
from sbi_rope.baselines.hvae_model import (
    ConditionalUNet,
    ContinuedPrior,
    HybridVAE,
    reparametrised_sample,
)
from sbi_rope.methods import Training
from sbi_rope.npe.sbi import headless
from sbi_rope.tasks import get_task
from tests.baselines import log_prob, swing, train

# --- a linear-Gaussian model whose evidence is known ---
# theta ~ N(0, I_2), z ~ N(0, 1), x = A theta + B z + noise of standard deviation 0.5.

A = torch.tensor([[1.0, 0.0], [0.5, 1.0], [0.0, -1.0], [1.0, 1.0]])
B = torch.tensor([[0.5], [-1.0], [1.0], [0.3]])
NOISE_STD = 0.5
COVARIANCE = A @ A.T + B @ B.T + NOISE_STD**2 * torch.eye(4)
EVIDENCE = MultivariateNormal(torch.zeros(4), COVARIANCE)
PRECISION = torch.eye(2) + A.T @ A / NOISE_STD**2


class LinearFlow(nn.Module):
    """The exact q(theta | s) of simulations s = A theta + noise, as a flow."""

    input_shape = torch.Size((2,))

    def __init__(self) -> None:
        super().__init__()
        self.law = MultivariateNormal(torch.zeros(2), precision_matrix=PRECISION)

    def _mean(self, s: Tensor) -> Tensor:
        return s @ A @ self.law.covariance_matrix / NOISE_STD**2

    def sample(self, shape: torch.Size, s: Tensor) -> Tensor:
        return self._mean(s) + self.law.sample((*shape, len(s)))

    def log_prob(self, theta: Tensor, s: Tensor) -> Tensor:
        return self.law.log_prob(theta - self._mean(s))

    def inverse_transform(self, theta: Tensor, s: Tensor) -> Tensor:
        factor = torch.linalg.cholesky(PRECISION)
        return (theta - self._mean(s)) @ factor


class Encoder(nn.Module):
    """The exact q(z | x)."""

    def forward(self, x: Tensor) -> Independent:
        gain = torch.linalg.solve(COVARIANCE, B)
        return Independent(Normal(x @ gain, (1 - (B.T @ gain).squeeze()).sqrt()), 1)


class Shift(nn.Module):
    """x plus a multiple of B z, with a given standard deviation."""

    def __init__(self, factor: float, std: float) -> None:
        super().__init__()
        self.factor, self.std = factor, std

    def forward(self, x: Tensor, z: Tensor) -> Independent:
        mean = x.repeat_interleave(len(z) // len(x), dim=0) + self.factor * z @ B.T
        return Independent(Normal(mean, self.std), 1)


def linear_model() -> HybridVAE:
    return HybridVAE(
        Encoder(),
        Shift(-1.0, 1.0),
        Shift(1.0, NOISE_STD),
        npe=(nn.Identity(), LinearFlow()),
        physics=lambda theta: theta @ A.T,
        prior=ContinuedPrior(MultivariateNormal(torch.zeros(2), torch.eye(2))),
    )


def test_elbo_of_the_exact_posterior_is_the_evidence_for_every_draw() -> None:
    x = EVIDENCE.sample((200,))
    # The KL term is in closed form, so that single draws scatter about it.
    model = linear_model()
    repeated = model.elbo(x.repeat(500, 1)).reshape(500, 200)
    error = repeated.mean(dim=0) - EVIDENCE.log_prob(x)
    standard_error = repeated.std(dim=0) / math.sqrt(500)
    assert (error.abs() < 5 * standard_error + 1e-4).all()
    assert error.mean().abs() < 0.01


@pytest.mark.parametrize("name", ["maf", "zuko_unaf"])
def test_a_draw_moves_with_its_condition_so_that_its_noise_stays(name: str) -> None:
    theta = torch.randn(100, 2)
    x = torch.cat([theta, theta.sin()], dim=1) + 0.3 * torch.randn(100, 4)
    flow: Any = headless(posterior_nn(name, num_transforms=2)(theta, x).eval())
    s, weights = torch.randn(10, 4, requires_grad=True), torch.randn(10, 2)

    def gradient_of_noise(theta: Tensor) -> Tensor:
        noise = flow.inverse_transform(theta, s)
        return torch.autograd.grad((weights * noise).sum(), s)[0]

    theta = reparametrised_sample(flow, s)
    assert gradient_of_noise(theta.detach()).abs().mean() > 0.01
    assert gradient_of_noise(theta).abs().max() < 1e-4


# --- the prior, continued ---


def test_continued_prior_is_the_prior_inside_and_falls_off_outside() -> None:
    prior = BoxUniform(torch.tensor([0.0, -1.0]), torch.tensor([2.0, 3.0]))
    continued = ContinuedPrior(prior)
    inside = torch.tensor([[0.5, 0.0], [1.9, 2.9]])
    torch.testing.assert_close(continued.log_prob(inside), prior.log_prob(inside))
    outside = torch.tensor([[2.0, 1.0], [3.0, 1.0], [4.0, 1.0]]).requires_grad_()
    values = continued.log_prob(outside)
    # exp(-d / (0.1 std)), the standard deviation being 2 / sqrt(12).
    slope = math.sqrt(12) / 2 / 0.1
    torch.testing.assert_close(
        values.diff(), torch.tensor([-slope, -slope]), rtol=0.02, atol=0
    )
    values.sum().backward()
    assert outside.grad is not None
    assert (outside.grad[:, 0] < 0).all()
    assert (outside.grad[:, 1] == 0).all()


def test_physics_sees_parameters_inside_the_support_alone() -> None:
    prior = BoxUniform(-0.1 * torch.ones(2), 0.1 * torch.ones(2))
    seen = []

    def recorded(theta: Tensor) -> Tensor:
        seen.append(theta.detach())
        return theta @ A.T

    model = linear_model()
    model.prior, model.physics = ContinuedPrior(prior), recorded
    assert torch.isfinite(model.elbo(EVIDENCE.sample((100,)))).all()
    assert torch.isfinite(prior.log_prob(seen[0])).all()
    assert (seen[0].abs() > 0.099).any()


def test_density_is_the_mean_over_all_draws_of_the_latent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    estimator = OverLatents(linear_model(), torch.randn(7, 1), torch.Size((4,)))
    x, theta = EVIDENCE.sample((3,)), torch.randn(5, 3, 2)
    law = Encoder()(x)
    expected = torch.zeros(5, 3)
    for epsilon in estimator.noise:
        z = law.mean + law.stddev * epsilon
        expected += LinearFlow().log_prob(theta, x - z @ B.T).exp() / 7
    for entries in (2**18, 4):  # however it is cut
        monkeypatch.setattr("sbi_rope.baselines.hvae.MAX_ENTRIES", entries)
        torch.testing.assert_close(estimator.log_prob(theta, x), expected.log())


# --- the networks ---


@pytest.mark.parametrize("event", [(50,), (3, 20, 33)])
def test_several_latents_of_one_x_are_the_same_as_one_at_a_time(
    event: tuple[int, ...],
) -> None:
    net = ConditionalUNet(torch.randn(100, *event), 5, width=4)
    for parameter in net.parameters():
        if not parameter.any():  # as after a training; few ReLUs are shut
            nn.init.uniform_(parameter, 0.1, 0.5)
    net = net.eval().double()
    x, z = torch.randn(3, *event).double(), torch.randn(3 * 4, 5).double()
    together = net(x, z)
    for i in range(12):
        alone = net(x[i // 4 : i // 4 + 1], z[i : i + 1])
        torch.testing.assert_close(together.mean[i], alone.mean[0])
        torch.testing.assert_close(together.stddev[i], alone.stddev[0])
    # Each latent reaches both outputs.
    for k in range(5):
        moved = net(x, z + torch.eye(5)[k])
        assert (moved.mean != together.mean).double().mean() > 0.9
        assert (moved.stddev != together.stddev).double().mean() > 0.9


def test_the_net_starts_as_the_identity_at_the_variance_of_the_data() -> None:
    scale = torch.tensor([2.0, 3.0])[:, None, None]
    data = 1.0 + scale * torch.randn(50, 2, 20, 20)
    law = ConditionalUNet(data, 5, width=4)(data[:3], torch.randn(3, 5))
    torch.testing.assert_close(law.mean, data[:3])
    std = data.transpose(0, 1).flatten(1).std(dim=1)
    torch.testing.assert_close(law.stddev[0, :, 0, 0], std)


# --- the method ---


@pytest.mark.slow
def test_training_improves_on_npe_for_held_out_real_data() -> None:
    torch.manual_seed(0)
    task = get_task("pendulum")
    net = nn.Sequential(nn.Linear(200, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU())
    builder = posterior_nn(
        "maf", embedding_net=net, z_score_x="structured", num_transforms=2
    )
    training = Training(
        training_batch_size=50,
        learning_rate=3e-3,
        validation_fraction=0.2,
        max_num_epochs=15,
    )
    of_npe = Training(training_batch_size=100, learning_rate=2e-3, max_num_epochs=5)
    npe = PlainNPE(task.get_prior(), builder, npe_training=of_npe)
    npe = train(npe.append_simulations(*task.get_simulations(1000))).build_posterior()
    method = HVAE.from_posterior(npe, physics=swing, width=4, training=training)
    method.append_calibration(*task.get_calibration_set(200))
    method.append_observations(task.get_test_set(360)[1][300:])
    posterior = train(method).build_posterior()
    theta, x = (rows[:300] for rows in task.get_test_set(360))
    gain = log_prob(posterior, theta[None], x) - log_prob(npe, theta[None], x)
    assert float(gain.mean()) > 3 * float(gain.std()) / math.sqrt(300)
    history = method.history
    assert history.kept_validation_loss < history.validation_loss[0]
    estimator = posterior.posterior_estimator
    inside = headless(npe.posterior_estimator).state_dict()
    for name, value in estimator.densities.member(0).state_dict().items():
        assert torch.equal(value, inside[name])
