"""An NPE that does not fit simulations from the prior is noticed where it can be."""

import warnings
from typing import Any

import pytest
import torch
from sbi.inference import NPE, DirectPosterior
from sbi.neural_nets import posterior_nn
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.errors import RoPEWarning
from tests import gaussian, problems
from tests.stacks import QUIET, stacked

MESSAGE = "does not fit its simulations.*several rounds"


def narrow() -> DirectPosterior:
    """An NPE that is sure of theta near 0 whatever it sees, as after many rounds."""
    estimator = gaussian.GaussianEstimator()
    with torch.no_grad():
        estimator.net.weight.mul_(0.01)
        estimator.log_std.fill_(-3.0)
    return DirectPosterior(estimator, gaussian.prior())


def rope(posterior: Any, simulator: Any = gaussian.simulator) -> RoPE:
    finetuner = CalibrationFinetuner(max_num_epochs=2)
    return RoPE(posterior, simulator=simulator, finetuner=finetuner)


def messages(function: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        function()
    return [str(w.message) for w in caught if issubclass(w.category, RoPEWarning)]


def test_an_npe_of_one_observation_is_warned_of_once() -> None:
    x_o = gaussian.labelled(25)[1]
    conductor = rope(narrow())
    with pytest.warns(RoPEWarning, match=MESSAGE):
        conductor.embed(x_o, num_simulations=200, **QUIET)
    again = messages(lambda: conductor.embed(x_o, num_simulations=200, **QUIET))
    assert again == []


def test_a_stack_warns_of_an_npe_of_one_observation() -> None:
    conductor = rope(narrow()).append_calibration(*gaussian.labelled(10))
    with pytest.warns(RoPEWarning, match=MESSAGE):
        stacked(conductor, num_folds=2)


def test_an_npe_of_other_units_is_warned_of() -> None:
    def in_other_units(theta: Tensor) -> Tensor:
        return 10 * gaussian.simulator(theta)

    conductor = rope(gaussian.posterior(), in_other_units)
    with pytest.warns(RoPEWarning, match="other units"):
        conductor.embed(gaussian.labelled(25)[1], **QUIET)


@pytest.mark.medium
def test_an_npe_that_fits_its_simulations_is_not_warned_of() -> None:
    x_o = gaussian.labelled(25)[1]
    for posterior, simulator, x in (
        (gaussian.posterior(), gaussian.simulator, x_o),
        # Neither few epochs nor a density that cannot be evaluated are a reason.
        (problems.npe_posterior(), problems.simulate, torch.randn(25, 3)),
        (problems.npe_posterior("mnpe"), _simulate_some, torch.randn(25, 3)),
        (problems.vector_field_posterior("fmpe"), problems.simulate, torch.ones(25, 3)),
    ):
        conductor = rope(posterior, simulator)
        assert messages(lambda rope=conductor, x=x: rope.embed(x, **QUIET)) == []


def _simulate_some(theta: Tensor) -> Tensor:
    return problems.simulate(theta[:, :2])


def two_moons(theta: Tensor) -> Tensor:
    """The two moons of sbi's benchmark."""
    angle = torch.pi * (torch.rand(len(theta)) - 0.5)
    radius = 0.1 + 0.01 * torch.randn(len(theta))
    x = torch.stack([radius * angle.cos() + 0.25, radius * angle.sin()], dim=1)
    a, b = theta.unbind(dim=1)
    return x + torch.stack([-(a + b).abs(), b - a], dim=1) / 2**0.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Maximum number of epochs")
def test_an_npe_of_several_rounds_of_sbi_is_warned_of() -> None:
    prior = problems.box(2, -2.0, 2.0)
    builder = posterior_nn("mdn")
    npe = NPE(prior, density_estimator=builder, show_progress_bars=False)
    proposal: Any = prior
    for _ in range(4):
        theta = proposal.sample((500,))
        npe.append_simulations(theta, two_moons(theta), proposal=proposal)
        npe.train(max_num_epochs=40, training_batch_size=100)
        proposal = npe.build_posterior().set_default_x(two_moons(torch.ones(1, 2)))
    with pytest.warns(RoPEWarning, match=MESSAGE):
        rope(proposal, two_moons).embed(torch.zeros(25, 2), **QUIET)
