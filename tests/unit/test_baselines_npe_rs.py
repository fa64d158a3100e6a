"""NPE-RS: the discrepancy is right, and pulls embeddings together in training only."""

import math
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope._sbi import embed, embedding_of
from sbi_rope.baselines import NPERS, PlainNPE, Training
from sbi_rope.baselines.npe_rs import squared_mmd
from sbi_rope.errors import RoPEWarning
from tests.problems import standard_normal

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of epochs")

SHORT = Training(training_batch_size=50, max_num_epochs=2)
NOISE_STD = 0.5
# A second reading of the same parameter, off by this much in reality.
SHIFT = 3.0


def brute_force(simulated: Tensor, observed: Tensor) -> float:
    """The double sums, one pair at a time."""

    def squared_distance(a: Tensor, b: Tensor) -> float:
        return sum(float(u - v) ** 2 for u, v in zip(a, b, strict=True))

    distances = sorted(squared_distance(a, b) for a in simulated for b in simulated)
    median = distances[(len(distances) - 1) // 2]

    def mean(xs: Tensor, ys: Tensor) -> float:
        values = [math.exp(-squared_distance(x, y) / median) for x in xs for y in ys]
        return sum(values) / len(values)

    return (
        mean(simulated, simulated)
        + mean(observed, observed)
        - 2 * mean(simulated, observed)
    )


def sets(m: int, n: int, dim: int = 3, **options: Any) -> tuple[Tensor, Tensor]:
    simulated = torch.randn(m, dim, dtype=torch.float64)
    observed = 0.5 + 1.5 * torch.randn(n, dim, dtype=torch.float64)
    for value in (simulated, observed):
        value.requires_grad_(**options)
    return simulated, observed


class TestSquaredMMD:
    def test_it_is_the_double_sum(self) -> None:
        for m, n in [(7, 5), (6, 6), (8, 1)]:
            simulated, observed = sets(m, n, requires_grad=False)
            expected = brute_force(simulated, observed)
            assert float(squared_mmd(simulated, observed)) == pytest.approx(expected)

    def test_its_gradient_is_that_of_finite_differences(self) -> None:
        """The bandwidth included, which depends on the simulations."""
        for m, n in [(7, 5), (6, 6), (8, 1)]:
            assert torch.autograd.gradcheck(squared_mmd, sets(m, n, requires_grad=True))

    def test_embeddings_that_have_collapsed_give_no_nan(self) -> None:
        for simulated, observed, expected in [
            (torch.ones(6, 2), torch.ones(4, 2), 0.0),
            (torch.ones(6, 2), torch.zeros(4, 2), 2.0),
            (1e-12 * torch.randn(6, 2), torch.ones(4, 2), 2.0),
            (1e-30 * torch.randn(6, 2), torch.ones(4, 2), 2.0),
            (torch.zeros(6, 2), torch.full((4, 2), 1e-30), None),
            (torch.tensor([[0.0], [0], [0], [0], [1]]), torch.ones(4, 1), None),
        ]:
            simulated.requires_grad_()
            observed.requires_grad_()
            value = squared_mmd(simulated, observed)
            assert torch.isfinite(value)
            if expected is not None:
                assert value.item() == pytest.approx(expected, abs=1e-6)
            for gradient in torch.autograd.grad(value, (simulated, observed)):
                assert torch.isfinite(gradient).all()


def net() -> nn.Module:
    return nn.Sequential(nn.Linear(2, 16), nn.ReLU(), nn.Linear(16, 2))


def builder(embedding_net: nn.Module) -> Any:
    return posterior_nn(
        "mdn", embedding_net=embedding_net, hidden_features=16, num_components=1
    )


def simulate(theta: Tensor, shift: float = 0.0) -> Tensor:
    """Two noisy readings of a parameter; the second can be off."""
    offset = torch.tensor([0.0, shift])
    return theta + offset + NOISE_STD * torch.randn(len(theta), 2)


def method(
    n: int,
    *,
    embedding_net: nn.Module | None = None,
    shift: float = 0.0,
    kind: type = NPERS,
    training: Training = SHORT,
    **options: Any,
) -> Any:
    """A method that has seen n simulations and 200 observations."""
    torch.manual_seed(1)
    prior = standard_normal(1)
    theta, theta_o = prior.sample((n,)), prior.sample((200,))
    x, x_o = simulate(theta), simulate(theta_o, shift)
    density = builder(net() if embedding_net is None else embedding_net)
    if kind is PlainNPE:
        method = PlainNPE(prior, density, npe_training=training)
        return method.append_simulations(theta, x)
    method = NPERS(prior, density, training=training, **options)
    return method.append_simulations(theta, x).append_observations(x_o)


def trained(n: int = 100, **options: Any) -> Any:
    return method(n, **options).train(seed=0, show_progress_bars=False)


def densities(method: Any) -> Tensor:
    torch.manual_seed(2)
    theta = standard_normal(1).sample((50,))
    return method.build_posterior().log_prob_batched(
        theta[None], simulate(theta), norm_posterior=False
    )


CONVERGED = Training(
    training_batch_size=100, learning_rate=1e-2, max_num_epochs=30, stop_after_epochs=30
)


class TestWhatItLearns:
    def scores(self, method: Any, shift: float) -> tuple[float, float, float]:
        """Mean log density of 2000 fresh pairs, the exact one, and the gap of h.

        The gap is the largest distance between the means of real and simulated
        embeddings, in standard deviations of the latter.
        """
        torch.manual_seed(3)
        theta = standard_normal(1).sample((2000,))
        x, x_o = simulate(theta), simulate(theta, shift)
        posterior = method.build_posterior()
        log_prob = posterior.log_prob_batched(theta[None], x_o, norm_posterior=False)
        variance = 1 / (1 + 2 / NOISE_STD**2)
        undone = x_o - torch.tensor([0.0, shift])
        mean = undone.sum(dim=1, keepdim=True) * variance / NOISE_STD**2
        exact = torch.distributions.Normal(mean, variance**0.5).log_prob(theta)
        embedding = embedding_of(posterior.posterior_estimator)
        real, simulated = embed(embedding, x_o), embed(embedding, x)
        gap = (real.mean(0) - simulated.mean(0)).abs() / simulated.std(0)
        return float(log_prob.mean()), float(exact.mean()), float(gap.max())

    @pytest.mark.slow
    def test_where_the_simulator_is_right_it_stays_near_npe(self) -> None:
        """Within 0.1 nats of NPE and of the exact posterior; of the prior it is 1."""
        npe = trained(1000, kind=PlainNPE, training=CONVERGED)
        robust = trained(1000, training=CONVERGED)
        npe_score, exact, _ = self.scores(npe, 0.0)
        score, _, _ = self.scores(robust, 0.0)
        assert abs(score - npe_score) < 0.1
        assert abs(score - exact) < 0.1

    @pytest.mark.slow
    def test_where_a_statistic_is_wrong_real_and_simulated_embeddings_meet(
        self,
    ) -> None:
        """At less than a fifth of the distance of NPE, which is 15 nats off.

        The posterior loses at most 1.5 nats of the exact one.
        """
        npe = trained(1000, kind=PlainNPE, training=CONVERGED)
        robust = trained(1000, shift=SHIFT, training=CONVERGED)
        npe_score, exact, npe_gap = self.scores(npe, SHIFT)
        score, _, gap = self.scores(robust, SHIFT)
        assert gap < npe_gap / 5
        assert npe_score < exact - 10
        assert score > exact - 1.5


def test_without_regularisation_it_is_npe() -> None:
    expected = densities(trained(kind=PlainNPE))
    assert torch.equal(densities(trained(regularisation=0)), expected)
    assert not torch.equal(densities(trained()), expected)


@pytest.mark.parametrize("frozen", [True, False])
def test_without_a_net_to_regularise_it_is_npe_and_says_so(frozen: bool) -> None:
    embedding_net = nn.Linear(2, 2) if frozen else nn.Identity()
    embedding_net.requires_grad_(requires_grad=False)
    expected = densities(trained(kind=PlainNPE, embedding_net=embedding_net))
    with pytest.warns(RoPEWarning, match="nothing to regularise"):
        robust = trained(embedding_net=embedding_net)
    assert torch.equal(densities(robust), expected)


def test_batch_statistics_are_those_of_the_simulations() -> None:
    """In front of the net, where standardised simulations have mean 0."""
    # In evaluation mode, as sbi asks: it tries the net on one observation first.
    embedding_net = nn.Sequential(nn.BatchNorm1d(2), nn.Linear(2, 2)).eval()
    robust = trained(400, embedding_net=embedding_net, shift=100.0)
    embedding: Any = embedding_of(robust.build_posterior().posterior_estimator)
    (norm,) = [m for m in embedding.modules() if isinstance(m, nn.BatchNorm1d)]
    assert norm.running_mean.abs().max() < 0.3
    assert norm.num_batches_tracked >= 14


class Recorder(nn.Module):
    """A linear embedding that remembers what passes through it for the penalty."""

    seen: list[Tensor] = []  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(2, 2)

    def forward(self, x: Tensor) -> Tensor:
        # One row at a time comes only from sbi, which tries the net when it builds.
        if torch.is_grad_enabled() and not self.training and len(x) > 1:
            self.seen.append(x.detach())
        return self.linear(x)


@pytest.mark.medium
def test_each_step_draws_anew_from_all_simulations_and_observations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sbi_rope.baselines.npe_rs.NUM_ROWS", 30)
    Recorder.seen.clear()
    training = Training(training_batch_size=10, max_num_epochs=10)
    trained(embedding_net=Recorder(), training=training)
    num_steps = 10 * 9
    assert len(Recorder.seen) == 2 * num_steps
    for seen, total in [(0, 100), (1, 200)]:
        steps = Recorder.seen[seen::2]
        assert all(len(step.unique(dim=0)) == len(step) == 30 for step in steps)
        assert len(torch.cat(steps).unique(dim=0)) == total
        assert not torch.equal(steps[0], steps[1])
