"""FRISBI: its loss and mixture are the stated ones, and it learns from pairs."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope.baselines import FRISBI
from sbi_rope.baselines.frisbi import Aligned
from sbi_rope.methods import Training
from tests import gaussian, problems
from tests.baselines import train

TRAINING = Training(
    training_batch_size=64,
    learning_rate=1e-2,
    validation_fraction=0.2,
    stop_after_epochs=30,
    max_num_epochs=30,
)


def aligned() -> tuple[nn.Linear, Aligned, Tensor]:
    torch.manual_seed(0)
    g = nn.Linear(3, 2).double()
    mixing = Aligned(
        problems.Gaussians(1), g, torch.randn(7, 2).double(), torch.Size((3,)), 0.5
    )
    return g, mixing, torch.randn(4, 3).double()


def test_weights_cost_and_its_gradient_are_those_of_the_definition() -> None:
    """One observation at a time."""
    g, mixing, x = aligned()
    rows, costs = [], []
    for real in g(x):
        cost = torch.stack([((real - s) ** 2).sum() / 2 for s in mixing.simulated])
        rows.append(torch.exp(-cost / 0.5) / torch.exp(-cost / 0.5).sum())
        costs.append((rows[-1] * cost).sum())
    expected = torch.stack(costs).mean()
    torch.testing.assert_close(mixing.rows(mixing.embed(x)), torch.stack(rows).detach())
    found = mixing.transport_cost(x)
    torch.testing.assert_close(found, expected)
    # It passes through the weights, too.
    gradients = (torch.autograd.grad(cost, g.weight)[0] for cost in (found, expected))
    torch.testing.assert_close(*gradients)


def trained(**options: Any) -> Any:
    torch.manual_seed(0)
    method = FRISBI.from_posterior(
        gaussian.posterior(),
        simulator=gaussian.simulator,
        training=TRAINING,
        **{"gamma": 0.02, **options},
    )
    method.append_calibration(*gaussian.labelled(60))
    method.append_observations(gaussian.labelled(300)[1])
    return train(method)


@pytest.mark.medium
@pytest.mark.parametrize(
    "distilled", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_it_undoes_most_of_a_linear_error_for_observations_it_has_not_seen(
    distilled: bool,
) -> None:
    assert gaussian.nats_lost(gaussian.posterior()) > 1.0
    posterior = trained(distilled=distilled).build_posterior()
    assert gaussian.nats_lost(posterior) < 0.4


@pytest.mark.medium
def test_its_mixture_is_the_stated_sum_and_g_is_not_worse_than_h() -> None:
    method = trained()
    assert method.history.kept_validation_loss <= method.history.validation_loss[0]
    posterior: Any = method.build_posterior()
    mixing = posterior.posterior_estimator
    theta, x = gaussian.labelled(3)
    weights = mixing.rows(mixing.embed(x))
    law = gaussian.exact_posterior(mixing.simulated / gaussian.GAIN)
    log_q = law.log_prob(theta[:, None]).double()
    expected = (weights.log() + log_q).logsumexp(dim=1)
    found = posterior.log_prob_batched(theta[None], x)[0]
    torch.testing.assert_close(found.double(), expected, atol=2e-3, rtol=0)
