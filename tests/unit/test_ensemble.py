"""Networks trained at once are networks trained alone, to rounding."""

import copy
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from sbi.neural_nets.embedding_nets import (
    FCEmbedding,
    PermutationInvariantEmbedding,
)
from torch import Tensor, nn

from sbi_rope.density import Flow
from sbi_rope.npe.sbi import embedding_of, estimator_of, headless
from sbi_rope.tasks.networks import SeriesEmbedding
from sbi_rope.training.ensemble import Ensemble, embedded
from sbi_rope.training.fit import Training, fit
from tests import problems

ALONE: Any = {"label": "", "show_progress_bars": False}
NUM_MEMBERS, NUM_ROWS = 3, 12


class Transposed(nn.Linear):
    """Puts another dimension first, so that rows of members mix up."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.transpose(0, 1)).sum(dim=0)


class Recurrent(nn.GRU):
    """The last state of a GRU."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x)[1][0]


NETS: dict[str, tuple[Callable[[], nn.Module], tuple[int, ...]]] = {
    "linear": (lambda: nn.Sequential(nn.Linear(3, 4), nn.Tanh()), (3,)),
    "fully connected": (lambda: FCEmbedding(3, output_dim=4, num_hiddens=8), (3,)),
    "conv": (problems.SmallCNN, (1, 8, 8)),
    "recurrent": (lambda: Recurrent(2, 4, batch_first=True), (5, 2)),
    "sets": (
        lambda: PermutationInvariantEmbedding(
            nn.Linear(2, 4), 4, num_hiddens=8, output_dim=4
        ),
        (5, 2),
    ),
    "trials": (problems.TrialsNet, (4, 2)),
    "transposed": (lambda: nn.Sequential(Transposed(2, 4)), (5, 2)),
    "series": (lambda: SeriesEmbedding(num_steps=80, output_dim=4), (80,)),
}
FAMILIES = problems.FAMILIES


def estimator_behind(name: str) -> Any:
    make, shape = NETS[name]
    theta, x = torch.rand(60, 2), torch.randn(60, *shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        builder: Any = posterior_nn(
            "maf", embedding_net=make(), hidden_features=8, num_transforms=2
        )
        return builder(theta, x).eval()


def members(estimator: Any, count: int = NUM_MEMBERS) -> list[Any]:
    """Copies with different weights."""
    copies = [copy.deepcopy(estimator).eval() for _ in range(count)]
    with torch.no_grad():
        for one in copies[1:]:
            for weight in one.parameters():
                weight.add_(0.05 * torch.randn_like(weight))
    return copies


def pairs_for(estimator: Any) -> tuple[Tensor, Tensor]:
    """For each member pairs of its own, (E, B, d) and (E, B, *event)."""
    shape = NUM_MEMBERS, NUM_ROWS
    theta = 1.8 * torch.rand(*shape, *estimator.input_shape) - 0.9
    if estimator.input_shape[0] == 4:  # the last two are categories
        theta[..., 2:] = torch.randint(0, 2, (*shape, 2)).float()
    return theta, torch.randn(*shape, *estimator.condition_shape)


def check_as_trained_alone(estimator: Any) -> None:
    """Losses, gradients and an Adam step are those of members trained alone."""
    alone = members(estimator)
    flow = Flow.of(alone)
    theta, x = pairs_for(estimator)
    training = Training(
        learning_rate=1e-2, max_num_epochs=2, stop_after_epochs=9, clip_max_norm=0.5
    )
    histories = fit(
        flow,
        lambda _: [(theta, x)],
        lambda theta, x: flow.losses(theta, x).mean(dim=1),
        training,
        in_training_mode=False,
        **ALONE,
    )
    for e, one in enumerate(alone):
        optimiser = torch.optim.Adam(one.parameters(), lr=1e-2)
        for epoch in range(2):
            loss = -headless_log_prob(one, theta[e], x[e]).mean()
            found = histories[e].training_loss[epoch]
            assert found == pytest.approx(float(loss), rel=1e-3, abs=1e-4)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(one.parameters(), 0.5)
            optimiser.step()
        with torch.no_grad():
            expected = headless_log_prob(one, theta[e], x[e])
        of_each = flow.log_probs(theta[e][None], flow.embed(x[e]))[:, 0]
        assert torch.allclose(of_each[e].float(), expected, rtol=2e-3, atol=2e-3)


def headless_log_prob(estimator: Any, theta: Tensor, x: Tensor) -> Tensor:
    z = embedding_of(estimator)(x)
    return headless(estimator).log_prob(theta[None], z)[0]


@pytest.mark.parametrize(
    "family",
    [
        pytest.param(name, marks=[pytest.mark.medium] if "zuko" in name else [])
        for name in [*FAMILIES, "mnpe"]
    ],
)
def test_every_family_is_trained_at_once_as_alone(family: str) -> None:
    check_as_trained_alone(estimator_of(problems.npe_posterior(family)))


@pytest.mark.parametrize("name", NETS)
def test_every_embedding_net_is_trained_at_once_as_alone(name: str) -> None:
    check_as_trained_alone(estimator_behind(name))


@pytest.mark.parametrize("name", ["linear", "transposed", "recurrent"])
def test_members_can_be_moved_taken_out_and_joined(name: str) -> None:
    make, shape = NETS[name]
    each = members(make())
    x = torch.randn(5, *shape)
    ensemble = Ensemble(each, embedded, (x,)).double().float()
    some = ensemble[[2, 0]]
    both = Ensemble.joined([some, ensemble])
    assert (len(some), len(both)) == (2, 5)
    found = both.answer(embedded, x.repeat(5, *[1] * (x.ndim - 1))).chunk(5)
    with torch.no_grad():  # copies
        for weight in some.parameters():
            weight.zero_()
    for place, number in enumerate((2, 0, 0, 1, 2)):
        expected = each[number](x)
        assert torch.allclose(found[place], expected, atol=1e-5)
        assert torch.allclose(both.member(place)(x), expected, atol=1e-5)
        assert torch.allclose(ensemble.member(number)(x), expected, atol=1e-5)
