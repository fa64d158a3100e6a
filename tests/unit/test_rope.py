"""RoPE: the order of its steps, what is used again, and what is refused."""

import copy
import warnings
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior
from torch import Tensor, nn

from sbi_rope import (
    CalibrationFinetuner,
    RoPE,
    SinkhornCoupler,
)
from sbi_rope.data.simulate import Stored
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    RoPEWarning,
    UnsupportedPosteriorError,
)
from tests import gaussian, problems

QUICK = CalibrationFinetuner(max_num_epochs=20)


def rope(**options: object) -> RoPE:
    arguments = {"simulator": gaussian.simulator, "finetuner": QUICK, **options}
    return RoPE(gaussian.posterior(), **arguments)  # type: ignore[arg-type]


def trained(**options: object) -> RoPE:
    conductor = rope(**options).append_calibration(*gaussian.labelled(20))
    return conductor.train(seed=0, show_progress_bars=False)


X_O = gaussian.real_process(torch.linspace(-1, 1, 60).reshape(30, 2))


def test_without_calibration_g_is_h() -> None:
    conductor = rope()
    posterior = conductor.build_posterior(X_O, seed=3)
    h = conductor.embedding_net
    with torch.no_grad():
        expected = SinkhornCoupler().couple(h(X_O), posterior.coupling.simulated)
    assert torch.allclose(posterior.weights, expected.weights)


def test_training_needs_pairs_and_building_a_posterior_needs_training() -> None:
    conductor = rope()
    with pytest.raises(NotReadyError, match="append_calibration"):
        conductor.train()
    for name in ("history", "tuned_embedding_net"):
        with pytest.raises(NotReadyError, match=r"`train\(\)` first"):
            getattr(conductor, name)
    with pytest.raises(NotReadyError, match=r"`train\(\)` first"):
        conductor.tuned_posterior()
    conductor.append_calibration(*gaussian.labelled(10))
    with pytest.raises(NotReadyError, match="10 calibration pairs were appended"):
        conductor.build_posterior(X_O)
    conductor.train(show_progress_bars=False)
    conductor.build_posterior(X_O)
    # New pairs make the training stale.
    conductor.append_calibration(*gaussian.labelled(10))
    with pytest.raises(NotReadyError, match="20 calibration pairs"):
        conductor.build_posterior(X_O)


def test_the_trained_state_serves_many_batches_and_couplers() -> None:
    conductor = trained()
    before = copy.deepcopy(conductor.tuned_embedding_net.state_dict())
    first = conductor.build_posterior(X_O, seed=0)
    sharp = conductor.build_posterior(X_O, seed=0, coupler=SinkhornCoupler(gamma=0.05))
    other = conductor.build_posterior(X_O[:25] + 0.1, seed=0)
    again = conductor.build_posterior(X_O, seed=0)
    assert torch.equal(first.weights, again.weights)
    assert torch.equal(first.coupling.simulated, sharp.coupling.simulated)
    assert (
        sharp.coupling.effective_sample_size < first.coupling.effective_sample_size
    ).all()
    assert other.weights.shape == (25, 1000)
    after = conductor.tuned_embedding_net.state_dict()
    assert all(torch.equal(before[k], after[k]) for k in before)


def test_the_users_posterior_and_data_are_left_as_they_were() -> None:
    npe = gaussian.posterior()
    npe.posterior_estimator.train()
    before = copy.deepcopy(npe.posterior_estimator.state_dict())
    theta, x = gaussian.labelled(20)
    theta_before, x_before = theta.clone(), x.clone()
    conductor = RoPE(npe, simulator=gaussian.simulator, finetuner=QUICK)
    conductor.append_calibration(theta, x).train(show_progress_bars=False)
    posterior = conductor.build_posterior(X_O)
    posterior.log_prob_batched(torch.zeros(30, 2), X_O)
    after = npe.posterior_estimator.state_dict()
    assert all(torch.equal(before[k], after[k]) for k in before)
    assert all(p.requires_grad for p in npe.posterior_estimator.parameters())
    assert npe.posterior_estimator.training
    assert npe.default_x is None
    assert torch.equal(theta, theta_before)
    assert torch.equal(x, x_before)
    # Nor does changing the data in place change the posterior.
    batch = X_O.clone()
    mine = conductor.build_posterior(batch)
    batch.zero_()
    assert torch.equal(mine.x_o, X_O)


def test_seeds_make_results_repeatable_and_leave_the_callers_state() -> None:
    npe, pairs = gaussian.posterior(), gaussian.labelled(20)
    state = torch.get_rng_state()
    conductor = RoPE(npe, simulator=gaussian.simulator, finetuner=QUICK)
    conductor.append_calibration(*pairs).train(seed=3, show_progress_bars=False)
    g = conductor.tuned_embedding_net(X_O)
    conductor.train(seed=3, show_progress_bars=False)
    assert torch.equal(conductor.tuned_embedding_net(X_O), g)
    one = conductor.build_posterior(X_O, seed=7)
    two = conductor.build_posterior(X_O, seed=7)
    three = conductor.build_posterior(X_O, seed=8)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(one.weights, two.weights)
    assert not torch.equal(one.weights, three.weights)


def test_calibration_targets_are_the_mean_embedding_of_fresh_simulations() -> None:
    theta, x = gaussian.labelled(12)
    conductor = rope(finetuner=CalibrationFinetuner(max_num_epochs=1))
    conductor.append_calibration(theta, x).train(seed=0, show_progress_bars=False)
    expected = gaussian.GAIN * (x - theta)  # h(x_o) minus E[h(S(theta))]
    history = conductor.history
    measured = (10 * history.training_loss[0] + 2 * history.validation_loss[0]) / 12
    # 100 draws a target: the noise of the mean is 0.8 * 0.5 / 10.
    assert measured == pytest.approx(float(expected.norm(dim=1).mean()), abs=0.03)


def test_stored_simulations_can_replace_a_simulator() -> None:
    theta = gaussian.prior().sample((500,))
    x = gaussian.simulator(theta)
    x[:3] = torch.nan
    with pytest.warns(RoPEWarning, match="Dropped 3 of 500 stored simulations"):
        conductor = RoPE(gaussian.posterior(), simulations=(theta, x), finetuner=QUICK)
    posterior = conductor.build_posterior(X_O)
    assert posterior.weights.shape == (30, 497)
    assert conductor.build_posterior(X_O, num_simulations=50).weights.shape == (30, 50)
    # The targets are the simulations with the nearest parameters.
    cal = theta[100:110]
    conductor.append_calibration(cal, x[100:110]).train(show_progress_bars=False)
    assert conductor.history.training_loss[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-30])
def test_the_nearest_parameters_are_found_in_units_of_their_standard_deviations(
    unit: float,
) -> None:
    x = torch.tensor([[0.0, 0.0], [0.0, 50.0], [1.0, 0.0]]).repeat(5, 1)
    wide = unit * x
    # In plain units (0, 50) is nearest. In standard deviations, about 0.5 and 24, 40 of
    # the second parameter count for less than 0.9 of the first.
    theta = unit * torch.tensor([[0.9, 40.0]])
    assert Stored(wide, x).near(theta, 1, lambda x: x).tolist() == [[[1.0, 0.0]]]


THETA, X = torch.zeros(10, 2), torch.zeros(10, 2)


def test_parameters_outside_the_prior_are_refused() -> None:
    npe = DirectPosterior(gaussian.GaussianEstimator(), problems.box(2))
    theta = torch.tensor([[0.0, 0.0], [0.0, 1.5], [0.5, 0.5]])
    with pytest.raises(
        InvalidInputError, match=r"1 of 3 rows \(first: \[1\]\) outside"
    ):
        RoPE(npe, simulator=gaussian.simulator).append_calibration(theta, theta)
    with pytest.raises(InvalidInputError, match=r"`simulations\[0\]` inside the supp"):
        RoPE(npe, simulations=(THETA + 5, X))


class Centred(nn.Module):
    """Subtracts the mean of a batch."""

    def forward(self, x: Tensor) -> Tensor:
        return x - x.mean(dim=0)


def test_a_net_whose_embedding_depends_on_other_rows_is_refused() -> None:
    posterior = gaussian.posterior()
    estimator: Any = posterior.posterior_estimator
    estimator.net = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    RoPE(posterior, simulator=gaussian.simulator)
    estimator.net = nn.Sequential(nn.Linear(2, 2), Centred())
    with pytest.raises(UnsupportedPosteriorError, match="reads each observation by"):
        RoPE(posterior, simulator=gaussian.simulator)


def test_stored_parameters_that_are_no_draws_of_the_prior_are_warned_of() -> None:
    theta = gaussian.prior().sample((1000,))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RoPEWarning)
        RoPE(gaussian.posterior(), simulations=(theta, gaussian.simulator(theta)))
    theta[:, 1] *= 0.5
    with pytest.warns(RoPEWarning, match=r"parameters \[1\] .* not distributed like"):
        RoPE(gaussian.posterior(), simulations=(theta, gaussian.simulator(theta)))
