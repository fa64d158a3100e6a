"""The HVAE: bound, gradients, networks, mixture and training."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import Tensor, nn
from torch.distributions import Independent, MultivariateNormal, Normal

from sbi_rope.baselines.hvae import HVAE, OverLatents
from sbi_rope.baselines.hvae_model import (
    ConditionalUNet,
    ContinuedPrior,
    HybridVAE,
    reparametrised_sample,
)
from sbi_rope.methods import Training
from sbi_rope.npe.sbi import headless
from sbi_rope.tasks.pendulum import PendulumSimulator
from tests.baselines import swing

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
    """The exact q(z | x), moved by ``shift`` standard deviations."""

    def __init__(self, shift: float = 0.0) -> None:
        super().__init__()
        gain = torch.linalg.solve(COVARIANCE, B)
        self.variance = 1 - (B.T @ gain).squeeze()
        self.gain, self.shift = gain, shift

    def forward(self, x: Tensor) -> Independent:
        std = self.variance.sqrt()
        return Independent(Normal(x @ self.gain + self.shift * std, std), 1)


class Shift(nn.Module):
    """x plus a multiple of B z, with a given standard deviation."""

    def __init__(self, factor: float, std: float) -> None:
        super().__init__()
        self.factor, self.std = factor, std

    def forward(self, x: Tensor, z: Tensor) -> Independent:
        mean = x.repeat_interleave(len(z) // len(x), dim=0) + self.factor * z @ B.T
        return Independent(Normal(mean, self.std), 1)


def linear_model(shift: float = 0.0) -> HybridVAE:
    return HybridVAE(
        Encoder(shift),
        Shift(-1.0, 1.0),
        Shift(1.0, NOISE_STD),
        npe=(nn.Identity(), LinearFlow()),
        physics=lambda theta: theta @ A.T,
        prior=ContinuedPrior(MultivariateNormal(torch.zeros(2), torch.eye(2))),
    )


def test_elbo_of_the_exact_posterior_is_the_evidence_for_every_draw() -> None:
    torch.manual_seed(0)
    x = EVIDENCE.sample((200,))
    # The KL term is in closed form, so that single draws scatter about it.
    model = linear_model()
    repeated = model.elbo(x.repeat(500, 1)).reshape(500, 200)
    error = repeated.mean(dim=0) - EVIDENCE.log_prob(x)
    standard_error = repeated.std(dim=0) / math.sqrt(500)
    assert (error.abs() < 5 * standard_error + 1e-4).all()
    assert error.mean().abs() < 0.01


def test_elbo_of_a_shifted_encoder_is_lower_by_the_divergence() -> None:
    torch.manual_seed(0)
    x = EVIDENCE.sample((20_000,))
    gap = (EVIDENCE.log_prob(x) - linear_model(shift=1.5).elbo(x)).detach()
    # KL of two Gaussians of the same variance, 1.5 standard deviations apart. But theta
    # is then inferred at the wrong z, exactly, which costs nothing more.
    standard_error = float(gap.std()) / math.sqrt(len(gap))
    assert standard_error < 0.03
    assert float(gap.mean()) == pytest.approx(1.5**2 / 2, abs=4 * standard_error)


# --- draws with a gradient ---


@pytest.fixture
def double() -> Iterator[None]:
    """Make float64 the default, which nflows asks for where it makes tensors."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def flow(name: str) -> Any:
    torch.manual_seed(0)
    theta = torch.randn(100, 2)
    x = torch.cat([theta, theta.sin()], dim=1) + 0.3 * torch.randn(100, 4)
    options = {} if name in ("mdn", "made") else {"num_transforms": 2}
    return headless(posterior_nn(name, **options)(theta, x).eval())


@pytest.mark.medium
@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("name", ["maf", "zuko_unaf"])
def test_gradient_of_a_draw_is_that_of_finite_differences_at_fixed_noise(
    name: str,
) -> None:
    q = flow(name)
    s = torch.randn(10, 4).requires_grad_()
    theta = reparametrised_sample(q, s)
    direction, weights = torch.randn(10, 4), torch.randn(10, 2)
    (gradient,) = torch.autograd.grad((theta * weights).sum(), s)
    noise = q.inverse_transform(theta, s).detach()

    def at_same_noise(s: Tensor) -> Tensor:
        # By Newton's method, as some flows are inverted too coarsely for differences.
        point = theta.detach()
        for _ in range(10):
            point = point.clone().requires_grad_()
            u = q.inverse_transform(point, s)
            rows = [
                torch.autograd.grad(u[:, k].sum(), point, retain_graph=True)[0]
                for k in range(2)
            ]
            step = torch.linalg.solve(torch.stack(rows, 1), (u - noise)[..., None])
            point = (point - step[..., 0]).detach()
        return point

    s = s.detach()
    h = 1e-5
    difference = at_same_noise(s + h * direction) - at_same_noise(s - h * direction)
    expected = (difference / (2 * h) * weights).sum(dim=1)
    torch.testing.assert_close(
        (gradient * direction).sum(dim=1), expected, atol=1e-5, rtol=1e-4
    )


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


# --- the posterior ---


def mixture() -> OverLatents:
    torch.manual_seed(0)
    return OverLatents(linear_model(shift=1.0), torch.randn(7, 1), torch.Size((4,)))


def test_density_is_the_mean_over_all_draws_of_the_latent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    estimator = mixture()
    x, theta = EVIDENCE.sample((3,)), torch.randn(5, 3, 2)
    law = Encoder(1.0)(x)
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
    torch.manual_seed(0)
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

PRIOR = BoxUniform(torch.tensor([0.0, 0.5]), torch.tensor([3.0, 10.0]))


def real(n: int) -> tuple[Tensor, Tensor]:
    theta = PRIOR.sample((n,))
    return theta, PendulumSimulator(max_damping=1.0)(theta)


def scores(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    return posterior.log_prob_batched(theta[None], x=x, norm_posterior=False)[0]


@pytest.mark.slow
def test_training_improves_on_npe_for_held_out_real_data_and_leaves_npe_alone() -> None:
    torch.manual_seed(0)
    theta = PRIOR.sample((2000,))
    net = nn.Sequential(nn.Linear(200, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU())
    builder = posterior_nn(
        "maf", embedding_net=net, z_score_x="structured", num_transforms=2
    )
    trainer = NPE(PRIOR, density_estimator=builder, show_progress_bars=False)
    trainer.append_simulations(theta, PendulumSimulator()(theta))
    trainer.train(max_num_epochs=10, training_batch_size=100, learning_rate=2e-3)
    npe = trainer.build_posterior()
    training = Training(
        training_batch_size=50,
        learning_rate=3e-3,
        validation_fraction=0.2,
        max_num_epochs=10,
    )
    method = HVAE.from_posterior(npe, physics=swing, width=2, training=training)
    method.append_calibration(*real(200)).append_observations(real(60)[1])
    posterior = method.train(seed=0, show_progress_bars=False).build_posterior()
    theta, x = real(300)
    gain = scores(posterior, theta, x) - scores(npe, theta, x)
    standard_error = float(gain.std()) / math.sqrt(len(gain))
    assert float(gain.mean()) > 3 * standard_error
    history = method.history
    assert history.kept_validation_loss < history.validation_loss[0]
    estimator = posterior.posterior_estimator
    inside = headless(npe.posterior_estimator).state_dict()
    for name, value in estimator.densities.member(0).state_dict().items():
        assert torch.equal(value, inside[name])
    net = npe.posterior_estimator.embedding_net
    for own, given in zip(
        estimator.nets.member(0).parameters(), net.parameters(), strict=True
    ):
        assert torch.equal(own, given)
