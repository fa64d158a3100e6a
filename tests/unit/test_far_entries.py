"""Entries of x that are far from simulations, or the same in all of them."""

import warnings
from typing import Any

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils.sbiutils import Standardize
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE, diagnose, stack
from sbi_rope.density import MixturePosterior, density_of
from sbi_rope.methods import FinetunedNPE, Training
from sbi_rope.npe.standardisation import deviations
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning
from tests import problems
from tests.stacks import DEFAULTS, quick

QUIET: dict[str, Any] = {"show_progress_bars": False}
PRIOR = problems.box(2)
THETA = torch.linspace(-0.9, 0.9, 60).repeat(2, 1).T
THETA_CAL = THETA[::2]


def simulator(theta: Tensor) -> Tensor:
    """Two readings, and a setting that never varies."""
    x = theta + 0.1 * torch.randn_like(theta)
    return torch.cat([x, torch.full_like(x[:, :1], 5.0)], dim=1)


def npe_of(z_score_x: Any, *, net: bool = False) -> object:
    estimator = posterior_nn(
        "mdn",
        z_score_x=z_score_x,
        hidden_features=5,
        num_components=1,
        embedding_net=nn.Linear(3, 2) if net else nn.Identity(),
    )
    trainer = NPE(PRIOR, density_estimator=estimator, **QUIET)
    trainer.append_simulations(THETA, simulator(THETA)).train(max_num_epochs=1)
    return trainer.build_posterior()


def real(theta: Tensor) -> Tensor:
    """As simulated, but the setting jitters."""
    x = simulator(theta)
    x[:, 2] += 0.01 * torch.randn(len(x))
    return x


def test_distances_from_simulations_count_below_as_above() -> None:
    net = Standardize(torch.tensor([2.0, -1.0]), torch.tensor([5.0, 0.1]))
    # What is missing is not far, and does not hide what is.
    x = torch.tensor([[-8.0, -2.0], [12.0, 0.0], [torch.nan, 99.0]])
    far: Any = deviations(net, x)
    assert torch.allclose(far, torch.tensor([[2.0, 10.0], [2.0, 10.0], [0.0, 1000.0]]))


IGNORED = r"1 of the 3 entries of `{}` \(first: \[2\]\) never vary in simulations"


@pytest.mark.medium
def test_an_entry_that_varies_only_in_reality_is_named_and_ignored() -> None:
    for net in (False, True):
        rope = RoPE(
            npe_of("independent", net=net),
            simulator=simulator,
            finetuner=CalibrationFinetuner(max_num_epochs=1),
        )
        with pytest.warns(RoPEWarning, match=IGNORED.format("x")):
            rope.append_calibration(THETA_CAL, real(THETA_CAL))
    rope.train(seed=0, **QUIET)
    with pytest.warns(RoPEWarning, match=IGNORED.format("x_o")):
        rope.build_posterior(real(THETA), **QUIET)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with quick():
            stacked = stack(rope, **DEFAULTS)
        looks = [
            diagnose(rope, x, num_simulations=100, num_folds=None, seed=0, **QUIET)
            for x in (real(THETA), 1000.0 * simulator(THETA))
        ]
        x = real(THETA[:5])
        for posterior in (rope.npe.posterior(), stacked):
            usual, other = (
                posterior.log_prob_batched(THETA[:5], one, norm_posterior=False)
                for one in (x, x + torch.tensor([0.0, 0.0, 1e6]))
            )
            assert torch.isfinite(usual).all()
            assert torch.equal(usual, other)
    usual, in_another_unit = (one["entries far from simulations"] for one in looks)
    assert not usual.alarming
    assert in_another_unit.alarming
    assert "Entry 2 of" not in in_another_unit.sentence


def test_x_that_is_too_long_without_a_net_is_refused_before_training() -> None:
    x = torch.randn(60, 501)
    npe = NPE(PRIOR, posterior_nn("mdn", hidden_features=5), **QUIET)
    npe.append_simulations(THETA, x).train(max_num_epochs=1)
    rope = RoPE(npe.build_posterior(), simulations=(THETA, x))
    rope.append_calibration(THETA_CAL, x[::2])
    with pytest.raises(InvalidInputError, match="Train NPE with an embedding net"):
        stack(rope, **DEFAULTS)


def test_an_amortised_posterior_warns_of_an_observation_in_another_unit() -> None:
    posterior = MixturePosterior(density_of(npe_of("independent")), PRIOR)
    x = simulator(THETA[:3])
    other = x * torch.tensor([1000.0, 1000.0, 1.0])
    with pytest.warns(RoPEWarning, match=r"\(first: \[0, 1\]\).*Check the units"):
        posterior.log_prob_batched(THETA[:3], other, norm_posterior=False)
    with pytest.warns(RoPEWarning, match="Check the units"):
        posterior.set_default_x(other[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior.sample_batched((1,), x, **QUIET)


def test_other_methods_that_start_from_npe_warn_too() -> None:
    training = Training(max_num_epochs=1)
    method = FinetunedNPE.from_posterior(npe_of("independent"), training=training)
    method.append_calibration(THETA_CAL, real(THETA_CAL))
    with pytest.warns(RoPEWarning, match=r"entries of `x` \(first: \[2\]\)"):
        method.train(seed=0, **QUIET)
