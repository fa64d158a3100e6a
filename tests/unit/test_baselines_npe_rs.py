"""NPE-RS: the discrepancy is right, and pulls embeddings together in training only."""

import math
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope.baselines import NPERS, PlainNPE
from sbi_rope.baselines.npe_rs import squared_mmd
from sbi_rope.methods import Training
from sbi_rope.npe.sbi import embed, embedding_of
from sbi_rope.utils.errors import RoPEWarning
from tests.baselines import log_prob, train
from tests.problems import standard_normal

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of epochs")

SHORT = Training(training_batch_size=50, max_num_epochs=2)
CONVERGED = Training(
    training_batch_size=100, learning_rate=1e-2, max_num_epochs=30, stop_after_epochs=30
)
NOISE_STD = 0.5
# A second reading of the same parameter, off by this much in reality.
SHIFT = 3.0


@pytest.mark.parametrize(("m", "n"), [(7, 5), (6, 6), (8, 1)])
def test_the_discrepancy_and_its_gradient_are_those_of_the_double_sum(
    m: int, n: int
) -> None:
    """The bandwidth included, which depends on the simulations."""
    simulated, observed = torch.randn(m, 3).double(), 0.5 + torch.randn(n, 3).double()
    squares = [float(((a - b) ** 2).sum()) for a in simulated for b in simulated]
    median = sorted(squares)[(m * m - 1) // 2]

    def mean(xs: Tensor, ys: Tensor) -> float:
        squares = [float(((x - y) ** 2).sum()) for x in xs for y in ys]
        return sum(math.exp(-one / median) for one in squares) / len(squares)

    within = mean(simulated, simulated) + mean(observed, observed)
    expected = within - 2 * mean(simulated, observed)
    assert float(squared_mmd(simulated, observed)) == pytest.approx(expected)
    both = simulated.requires_grad_(), observed.requires_grad_()
    assert torch.autograd.gradcheck(squared_mmd, both)


@pytest.mark.parametrize(
    ("simulated", "observed", "expected"),
    [
        (torch.ones(6, 2), torch.ones(4, 2), 0.0),
        (torch.ones(6, 2), torch.zeros(4, 2), 2.0),
        (1e-30 * torch.randn(6, 2), torch.ones(4, 2), 2.0),
    ],
)
def test_embeddings_that_have_collapsed_give_no_nan(
    simulated: Tensor, observed: Tensor, expected: float
) -> None:
    both = simulated.requires_grad_(), observed.requires_grad_()
    value = squared_mmd(*both)
    assert value.item() == pytest.approx(expected, abs=1e-6)
    assert all(grad.isfinite().all() for grad in torch.autograd.grad(value, both))


def simulate(theta: Tensor, shift: float = 0.0) -> Tensor:
    """Two noisy readings of a parameter; the second can be off."""
    offset = torch.tensor([0.0, shift])
    return theta + offset + NOISE_STD * torch.randn(len(theta), 2)


def trained(
    n: int = 100,
    *,
    net: nn.Module | None = None,
    shift: float = 0.0,
    kind: type = NPERS,
    training: Training = SHORT,
    **options: Any,
) -> Any:
    """The posterior of a method that has seen n simulations and 200 observations."""
    torch.manual_seed(1)
    prior = standard_normal(1)
    theta, theta_o = prior.sample((n,)), prior.sample((200,))
    x, x_o = simulate(theta), simulate(theta_o, shift)
    if net is None:
        net = nn.Sequential(nn.Linear(2, 16), nn.ReLU(), nn.Linear(16, 2))
    density = posterior_nn(
        "mdn", embedding_net=net, hidden_features=16, num_components=1
    )
    of_npe = kind is PlainNPE
    options["npe_training" if of_npe else "training"] = training
    method = kind(prior, density, **options).append_simulations(theta, x)
    if not of_npe:
        method.append_observations(x_o)
    return train(method).build_posterior()


def scores(posterior: Any, shift: float) -> tuple[float, float, float]:
    """Mean log density of 2000 fresh pairs, the exact one, and the gap of h.

    The gap is the largest distance between the means of real and simulated embeddings,
    in standard deviations of the latter.
    """
    torch.manual_seed(3)
    theta = standard_normal(1).sample((2000,))
    x, x_o = simulate(theta), simulate(theta, shift)
    variance = 1 / (1 + 2 / NOISE_STD**2)
    undone = x_o - torch.tensor([0.0, shift])
    mean = undone.sum(dim=1, keepdim=True) * variance / NOISE_STD**2
    exact = torch.distributions.Normal(mean, variance**0.5).log_prob(theta)
    embedding = embedding_of(posterior.posterior_estimator)
    real, simulated = embed(embedding, x_o), embed(embedding, x)
    gap = (real.mean(0) - simulated.mean(0)).abs() / simulated.std(0)
    found = log_prob(posterior, theta[None], x_o)
    return float(found.mean()), float(exact.mean()), float(gap.max())


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, SHIFT])
def test_embeddings_meet_where_a_statistic_is_wrong_and_npe_stays_where_not(
    shift: float,
) -> None:
    """The exact posterior is 1 nat above the prior, and NPE 10 nats below if wrong."""
    npe = trained(1000, kind=PlainNPE, training=CONVERGED)
    npe_score, exact, npe_gap = scores(npe, shift)
    score, _, gap = scores(trained(1000, shift=shift, training=CONVERGED), shift)
    if not shift:
        assert abs(score - npe_score) < 0.1
        assert abs(score - exact) < 0.1
        return
    assert gap < npe_gap / 5
    assert npe_score < exact - 10
    assert score > exact - 1.5


def test_without_regularisation_or_a_net_to_regularise_it_is_npe() -> None:
    theta = standard_normal(1).sample((50,))
    x, theta = simulate(theta), theta[None]
    expected = log_prob(trained(kind=PlainNPE), theta, x)
    assert torch.equal(log_prob(trained(regularisation=0), theta, x), expected)
    assert not torch.equal(log_prob(trained(), theta, x), expected)
    frozen = nn.Linear(2, 2).requires_grad_(requires_grad=False)
    with pytest.warns(RoPEWarning, match="nothing to regularise"):
        robust = trained(net=frozen)
    expected = log_prob(trained(kind=PlainNPE, net=frozen), theta, x)
    assert torch.equal(log_prob(robust, theta, x), expected)


def test_batch_statistics_are_those_of_the_simulations() -> None:
    """In front of the net, where standardised simulations have mean 0."""
    # In evaluation mode, as sbi asks: it tries the net on one observation first.
    net = nn.Sequential(nn.BatchNorm1d(2), nn.Linear(2, 2)).eval()
    embedding: Any = embedding_of(
        trained(400, net=net, shift=100.0).posterior_estimator
    )
    (norm,) = [m for m in embedding.modules() if isinstance(m, nn.BatchNorm1d)]
    assert norm.running_mean.abs().max() < 0.3
    assert norm.num_batches_tracked >= 14
