"""From every task to a posterior of RoPE."""

import warnings

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.tasks import TASKS
from tests.tasks import make, skip_without_data


@pytest.mark.medium
@pytest.mark.parametrize("name", sorted(TASKS))
def test_rope_runs_on_the_task(name: str) -> None:
    task = make(name)
    skip_without_data(task)
    theta, x = task.get_simulations(300)
    npe = NPE(
        task.get_prior(),
        density_estimator=posterior_nn(
            "mdn",
            embedding_net=task.get_embedding_net(light=True),
            z_score_x=task.z_score_x,
        ),
        show_progress_bars=False,
    )
    npe.append_simulations(theta, x)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Maximum number of epochs")
        npe.train(max_num_epochs=2)
    rope = RoPE(
        npe.build_posterior(),
        simulator=task.get_simulator(),
        finetuner=CalibrationFinetuner(max_num_epochs=20),
        coupler=SinkhornCoupler(gamma=0.3, cost_scale="simulated"),
    )
    rope.append_calibration(*task.get_calibration_set(12))
    rope.train(seed=0, show_progress_bars=False)
    theta_o, x_o = task.get_test_set(30)
    posterior = rope.build_posterior(x_o, num_simulations=100, seed=0)
    samples = posterior.sample_batched((50,), x=x_o, show_progress_bars=False)
    assert samples.shape == (50, 30, task.theta_dim)
    assert torch.isfinite(samples).all()
    log_prob = posterior.log_prob_batched(theta_o, x=x_o)
    assert log_prob.shape == (1, 30)
    assert not log_prob.isnan().any()
    assert torch.isfinite(log_prob).any()
