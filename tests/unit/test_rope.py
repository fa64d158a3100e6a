"""RoPE: the order of its steps, what is used again, and what is refused."""

import copy
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    RoPEWarning,
)
from tests import gaussian, problems

QUICK = CalibrationFinetuner(max_num_epochs=20)
X_O = gaussian.real_process(torch.linspace(-1, 1, 60).reshape(30, 2))


def rope(npe: Any = None, **options: Any) -> RoPE:
    npe = gaussian.posterior() if npe is None else npe
    return RoPE(npe, **{"simulator": gaussian.simulator, "finetuner": QUICK, **options})


def test_training_needs_pairs_and_building_a_posterior_needs_training() -> None:
    conductor = rope()
    with pytest.raises(NotReadyError, match="append_calibration"):
        conductor.train()
    for name in ("history", "tuned_embedding_net"):
        with pytest.raises(NotReadyError, match=r"`train\(\)` first"):
            getattr(conductor, name)
    conductor.append_calibration(*gaussian.labelled(10))
    with pytest.raises(NotReadyError, match="10 calibration pairs were appended"):
        conductor.build_posterior(X_O)
    conductor.train(show_progress_bars=False)
    conductor.build_posterior(X_O)
    # New pairs make the training stale.
    conductor.append_calibration(*gaussian.labelled(10))
    with pytest.raises(NotReadyError, match="20 calibration pairs"):
        conductor.build_posterior(X_O)


def test_the_trained_state_serves_many_batches_and_couplers_and_seeds_repeat() -> None:
    conductor = rope().append_calibration(*gaussian.labelled(20))
    state, sharp = torch.get_rng_state(), SinkhornCoupler(gamma=0.05)
    nets = [
        conductor.train(seed=3, show_progress_bars=False).tuned_embedding_net(X_O)
        for _ in range(2)
    ]
    assert torch.equal(*nets)
    first, again, other_seed = (
        conductor.build_posterior(X_O, seed=seed) for seed in (0, 0, 8)
    )
    sharper = conductor.build_posterior(X_O, seed=0, coupler=sharp)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(first.weights, again.weights)
    assert not torch.equal(first.weights, other_seed.weights)
    assert torch.equal(first.coupling.simulated, sharper.coupling.simulated)
    sizes = [one.coupling.effective_sample_size for one in (sharper, first)]
    assert (sizes[0] < sizes[1]).all()
    assert conductor.build_posterior(X_O[:25] + 0.1).weights.shape == (25, 1000)


def test_the_users_posterior_and_data_are_left_as_they_were() -> None:
    npe, pairs, batch = gaussian.posterior(), gaussian.labelled(20), X_O.clone()
    estimator: Any = npe.posterior_estimator.train()
    before, data = copy.deepcopy((estimator.state_dict(), pairs))
    conductor = rope(npe).append_calibration(*pairs).train(show_progress_bars=False)
    posterior = conductor.build_posterior(batch)
    after = estimator.state_dict()
    assert all(torch.equal(before[k], after[k]) for k in before)
    assert all(p.requires_grad for p in estimator.parameters())
    assert estimator.training
    assert all(map(torch.equal, pairs, data))
    # Nor does changing the data in place change the posterior.
    batch.zero_()
    assert torch.equal(posterior.x_o, X_O)


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
        conductor = rope(simulator=None, simulations=(theta, x))
    for number, count in ((None, 497), (50, 50)):
        posterior = conductor.build_posterior(X_O, num_simulations=number)
        assert posterior.weights.shape == (30, count)
    # The targets are means of simulations near the parameters.
    theta, x = theta[100:160], x[100:160]
    conductor.append_calibration(theta, x).train(show_progress_bars=False)
    expected = (gaussian.GAIN * (x - theta)).norm(dim=1).mean()
    assert conductor.history.training_loss[0] == pytest.approx(float(expected), abs=0.1)


def test_parameters_outside_the_prior_are_refused() -> None:
    npe = DirectPosterior(gaussian.GaussianEstimator(), problems.box(2))
    theta = torch.tensor([[0.0, 0.0], [0.0, 1.5], [0.5, 0.5]])
    with pytest.raises(InvalidInputError, match=r"1 of 3 rows \(first: \[1\]\) out"):
        rope(npe).append_calibration(theta, theta)
    with pytest.raises(InvalidInputError, match=r"`simulations\[0\]` inside the supp"):
        rope(npe, simulator=None, simulations=(theta + 5, theta))
