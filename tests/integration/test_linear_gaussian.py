"""RoPE where the right answer is known in closed form."""

from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, MixturePosterior, RoPE, SinkhornCoupler
from sbi_rope.density import Coupled
from sbi_rope.metrics import evaluate
from sbi_rope.npe.sbi import headless
from tests import gaussian


def with_exact_g(x_o: Tensor, n_s: int, coupler: SinkhornCoupler) -> MixturePosterior:
    """The mixture for g(x_o) = h of the simulation behind x_o."""
    npe = gaussian.posterior()
    h = npe.posterior_estimator.embedding_net
    with torch.no_grad():
        simulated = h(gaussian.simulator(gaussian.prior().sample((n_s,))))
        coupling = coupler.couple(h(gaussian.undo(x_o)), simulated)
    density = headless(npe.posterior_estimator)
    mixture = Coupled(density, simulated, x_o, h, coupling)
    mixture.tail_mass = 0.0
    return MixturePosterior(mixture, gaussian.prior())


def divergence(x_s: Tensor, posterior: MixturePosterior, draws: int = 30) -> float:
    """Mean over the batch of KL(exact || RoPE), by draws of the exact posterior."""
    exact = gaussian.exact_posterior(x_s)
    theta = exact.sample((draws,))
    log_prob = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    return float((exact.log_prob(theta) - log_prob).mean())


@pytest.mark.slow
def test_with_the_exact_g_the_mixture_approaches_the_exact_posterior() -> None:
    errors = []
    for n in (30, 150, 600):
        _, x_o = gaussian.labelled(n)
        coupler = SinkhornCoupler(gamma=0.02, tau=0.9)
        posterior = with_exact_g(x_o, n, coupler)
        errors.append(divergence(gaussian.undo(x_o), posterior))
    assert errors[0] > 1.5 * errors[1]
    assert errors[1] > 1.5 * errors[2]
    assert errors[2] < 0.05


def test_at_tau_one_the_mean_posterior_is_the_mean_of_the_simulated_ones() -> None:
    theta_cal, x_cal = gaussian.labelled(50)
    _, x_o = gaussian.labelled(100)
    rope = RoPE(
        gaussian.posterior(),
        simulator=gaussian.simulator,
        finetuner=CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=20),
    )
    rope.append_calibration(theta_cal, x_cal).train(show_progress_bars=False)
    posterior = rope.build_posterior(
        x_o,
        coupler=SinkhornCoupler(gamma=0.2, tau=1.0, tolerance=1e-10),
        num_simulations=150,
    )
    coupled: Any = posterior.posterior_estimator
    coupled.tail_mass = 0.0
    grid = torch.linspace(-3, 3, 7)
    theta = torch.cartesian_prod(grid, grid)
    batch = posterior.log_prob_batched(
        theta[:, None].expand(-1, 100, -1), x_o, norm_posterior=False
    )
    simulated = coupled.density.log_prob(
        theta[:, None].expand(-1, 150, -1), coupled.simulated
    )
    assert batch.exp().mean(dim=1).numpy() == pytest.approx(
        simulated.exp().mean(dim=1).detach().numpy(), abs=1e-6
    )


@pytest.mark.medium
def test_fifty_pairs_repair_the_posterior_of_a_scaled_and_shifted_process() -> None:
    theta_cal, x_cal = gaussian.labelled(50)
    theta_o, x_o = gaussian.labelled(1000)
    exact = float(gaussian.exact_posterior(gaussian.undo(x_o)).log_prob(theta_o).mean())
    npe = gaussian.posterior()
    rope = RoPE(
        npe, simulator=gaussian.simulator, coupler=SinkhornCoupler(gamma=0.05, tau=1.0)
    )
    rope.append_calibration(theta_cal, x_cal).train(seed=0, show_progress_bars=False)
    assert rope.history.learning_rate == 1e-3  # 1e-4 moves a linear map too little
    scores = {
        name: evaluate(posterior, theta_o, x_o, num_samples=200, seed=0)
        for name, posterior in {
            "npe": npe,
            "tuned": rope.tuned_posterior(),
            "rope": rope.build_posterior(x_o, seed=0),
        }.items()
    }
    assert scores["npe"].lpp.mean < exact - 1.5
    assert scores["npe"].acauc.mean > 0.1
    # The targets are means over noise, so g shrinks towards the prior mean, which the
    # flow takes at face value. A balanced coupling undoes it.
    assert scores["npe"].lpp.mean < scores["tuned"].lpp.mean - 1.0
    assert scores["tuned"].lpp.mean < scores["rope"].lpp.mean - 0.03
    assert scores["rope"].lpp.mean > exact - 0.15
    assert abs(scores["rope"].acauc.mean) < 0.03
