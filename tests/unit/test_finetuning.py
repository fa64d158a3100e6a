"""Fine-tuning: its loss, the net that it keeps, and what it does not change."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner
from sbi_rope.data.pairs import EPOCHS_WITHOUT_HOLDOUT
from sbi_rope.rope.finetuning import trainable_copy
from sbi_rope.training.fit import History
from sbi_rope.utils.errors import RoPEWarning
from sbi_rope.utils.seeds import seeded
from tests import gaussian


def linear() -> nn.Module:
    return gaussian.GaussianEstimator().net


def finetune(
    net: nn.Module, x: Tensor, targets: Tensor, **settings: Any
) -> tuple[Any, History]:
    with seeded(0):
        nets, [history] = CalibrationFinetuner(**settings).tuned(
            net,
            x,
            [targets],
            [torch.arange(len(x))],
            groups=torch.arange(len(x)),
            draw_simulations=lambda count: torch.ones(7, 1),
        )
    return nets.member(0), history


def test_the_first_losses_are_the_mean_unsquared_distances() -> None:
    x, targets = torch.randn(10, 2), torch.randn(10, 2)
    net = linear()
    _, history = finetune(net, x, targets, max_num_epochs=1)
    distances = ((net(x).detach() - targets) ** 2).sum(dim=1).sqrt()
    expected = (8 * history.training_loss[0] + 2 * history.validation_loss[0]) / 10
    assert float(distances.mean()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.medium
def test_many_pairs_lead_to_the_minimiser_known_in_closed_form() -> None:
    """The conditional median of 0.8 theta given x_o: 0.64 (x_o - 0.7) / 1.4.

    Not h of the simulation behind x_o, which has 0.8 in the place of 0.64: the targets
    average over the simulator's noise, and so g shrinks.
    """
    theta, x_o = gaussian.labelled(5000)
    settings = {"learning_rate": 3e-3, "max_num_epochs": 600}
    g, _ = finetune(linear(), x_o, gaussian.GAIN * theta, **settings)
    slope = gaussian.GAIN**2 / gaussian.SCALE
    assert torch.allclose(g.weight, slope * torch.eye(2), atol=0.02)
    assert torch.allclose(g.bias, -slope * gaussian.SHIFT * torch.ones(2), atol=0.02)


def test_the_net_that_is_kept_is_the_best_on_the_held_out_pairs() -> None:
    # Pure noise: any step away from the start overfits sooner or later.
    x, targets = torch.randn(20, 2), torch.randn(20, 2)
    net = nn.Sequential(nn.Linear(2, 64), nn.Tanh(), nn.Linear(64, 2))
    g, history = finetune(net, x, targets, learning_rate=1e-2)
    validation, best = history.validation_loss, history.best_epoch
    assert len(validation) == best + 1 + 200  # stopped by its stop_after_epochs
    assert validation[best] == min(validation)
    with seeded(0):
        held_out = torch.randperm(20)[:4]
    distance = (g(x) - targets).norm(dim=1)[held_out].mean()
    assert float(distance) == pytest.approx(validation[best], rel=1e-6)
    assert validation[-1] > validation[best]


def test_the_start_is_kept_if_nothing_is_better() -> None:
    x, net = torch.randn(10, 2), linear()
    g, history = finetune(net, x, net(x).detach(), learning_rate=0.1)
    assert history.best_epoch == 0
    assert history.validation_loss[0] == 0.0  # the norm has a kink here, and no NaN
    assert torch.equal(g(x), net(x))


@pytest.mark.medium
def test_a_net_without_parameters_gets_an_affine_map_that_starts_as_identity() -> None:
    x = torch.randn(50, 3)
    assert torch.equal(trainable_copy(nn.Identity(), x)(x), x)
    tuned, _ = finetune(nn.Identity(), x, 1.3 * x - 0.2, max_num_epochs=1000)
    assert (tuned(x) - (1.3 * x - 0.2)).norm(dim=1).mean() < 0.02


def test_without_a_hold_out_an_affine_map_gets_the_largest_rate() -> None:
    x = torch.randn(4, 2)
    for net, rate in ((linear(), 1e-4), (nn.Identity(), 1e-3)):
        with pytest.warns(RoPEWarning, match="at least 5 pairs"):
            _, history = finetune(net, x, 2 * x)
        assert history.best_epoch == EPOCHS_WITHOUT_HOLDOUT
        assert history.learning_rate == rate


@pytest.mark.filterwarnings("ignore:Only 4 calibration pairs")
def test_rehearsal_minimises_the_sum_known_in_closed_form() -> None:
    """With g(x) = a x, pairs (1, 2), simulations of 1: |a - 2| + rehearsal |a - 1|."""
    x = torch.ones(4, 1)  # too few for a hold-out, which would choose a = 2
    for rehearsal, slope in ((0.5, 2.0), (2.0, 1.0)):
        net = nn.Linear(1, 1, bias=False)
        nn.init.ones_(net.weight)
        settings = {"rehearsal": rehearsal, "learning_rate": 0.05}
        g, _ = finetune(net, x, 2 * x, **settings)
        assert float(g.weight) == pytest.approx(slope, abs=0.1)
