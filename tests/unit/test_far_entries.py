"""Entries of x that are far from simulations, or the same in all of them."""

import warnings

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils.sbiutils import Standardize
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE, diagnose, stack
from sbi_rope.baselines import CalibrationMLP, FinetunedNPE, Training
from sbi_rope.density import MixturePosterior, density_of
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.npe.standardisation import deviations
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning
from tests import problems
from tests.stacks import DEFAULTS, quick

QUIET = {"show_progress_bars": False}
PRIOR = problems.box(2)
THETA = torch.linspace(-0.9, 0.9, 60).repeat(2, 1).T
THETA_CAL = THETA[::2]


def simulator(theta: Tensor) -> Tensor:
    """Two readings, and a setting that never varies."""
    x = theta + 0.1 * torch.randn_like(theta)
    return torch.cat([x, torch.full_like(x[:, :1], 5.0)], dim=1)


def npe_of(z_score_x: str, *, net: bool = False) -> object:
    estimator = posterior_nn(
        "mdn",
        z_score_x=z_score_x,  # type: ignore[arg-type]
        hidden_features=5,
        num_components=1,
        embedding_net=nn.Linear(3, 2) if net else nn.Identity(),
    )
    trainer = NPE(PRIOR, density_estimator=estimator, show_progress_bars=False)
    trainer.append_simulations(THETA, simulator(THETA)).train(max_num_epochs=1)
    return trainer.build_posterior()


def real(theta: Tensor) -> Tensor:
    """As simulated, but the setting jitters."""
    return simulator(theta) + torch.tensor([0.0, 0.0, 0.01]) * torch.randn(
        len(theta), 1
    )


def test_distances_from_simulations_count_below_as_above() -> None:
    net = Standardize(torch.tensor([2.0, -1.0]), torch.tensor([5.0, 0.1]))
    far = deviations(net, torch.tensor([[-8.0, -2.0], [12.0, 0.0]]))
    assert far is not None
    assert torch.allclose(far, torch.tensor([[2.0, 10.0], [2.0, 10.0]]))
    # What is missing is not far, and does not hide what is.
    far = deviations(net, torch.tensor([[float("nan"), 99.0]]))
    assert far is not None
    assert torch.allclose(far, torch.tensor([[0.0, 1000.0]]))


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
        found = [
            [
                posterior.log_prob_batched(THETA[:5], other, norm_posterior=False)
                for other in (x, x + torch.tensor([0.0, 0.0, 1e6]))
            ]
            for posterior in (rope.npe.posterior(), stacked)
        ]
    usual, in_another_unit = (one["entries far from simulations"] for one in looks)
    assert not usual.alarming
    assert in_another_unit.alarming
    assert "Entry 2 of" not in in_another_unit.sentence
    for before, after in found:
        assert torch.isfinite(before).all()
        assert torch.equal(before, after)


def test_x_that_is_too_long_without_a_net_is_refused_before_training() -> None:
    x = torch.randn(60, 501)
    npe = NPE(PRIOR, posterior_nn("mdn", hidden_features=5), **QUIET)
    npe.append_simulations(THETA, x).train(max_num_epochs=1)
    rope = RoPE(npe.build_posterior(), simulations=(THETA, x))
    rope.append_calibration(THETA_CAL, x[::2])
    method = DiscrepancyNPE.from_posterior(rope.npe.posterior())
    method.append_simulations(THETA, x).append_calibration(THETA_CAL, x[::2])
    for train in (lambda: stack(rope, **DEFAULTS), lambda: method.train(**QUIET)):
        with pytest.raises(InvalidInputError, match="Train NPE with an embedding net"):
            train()


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
    cases: tuple[tuple[type, dict[str, object]], ...] = (
        (FinetunedNPE, {"training": Training(max_num_epochs=1)}),
        (DiscrepancyNPE, {"simulator": simulator, "num_steps": 1}),
    )
    for kind, options in cases:
        torch.manual_seed(0)
        method = kind.from_posterior(npe_of("independent"), **options)
        method.append_calibration(THETA_CAL, real(THETA_CAL))
        with pytest.warns(RoPEWarning, match=r"entries of `x` \(first: \[2\]\)"):
            method.train(seed=0, **QUIET)


def test_a_network_of_real_observations_ignores_their_constant_entries() -> None:
    method = CalibrationMLP(PRIOR, training=Training(max_num_epochs=50))
    method.append_calibration(THETA_CAL, simulator(THETA_CAL))
    posterior, x = method.train(seed=0, **QUIET).build_posterior(), simulator(THETA)
    changed = x + torch.tensor([0.0, 0.0, 100.0])
    usual, other = (
        posterior.log_prob_batched(THETA, x=x, norm_posterior=False)
        for x in (x, changed)
    )
    assert torch.equal(usual, other)
    assert torch.isfinite(usual).all()


def test_the_posterior_of_such_a_network_has_mass_inside_the_prior_for_any_x() -> None:
    method = CalibrationMLP(PRIOR, training=Training(max_num_epochs=50))
    method.append_calibration(THETA_CAL, THETA_CAL + 1e-4 * torch.randn(30, 2))
    posterior = method.train(seed=0, **QUIET).build_posterior()
    far = torch.tensor([[1e4, -1e4], [-1e4, -1e4]])
    samples = posterior.sample_batched((200,), x=far, **QUIET)
    assert (samples.abs() <= 1).all()
