"""What a stack is worth where the exact posterior is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.baselines import FinetunedNPE
from sbi_rope.baselines.training import Training
from sbi_rope.stacking import (
    DensityCandidate,
    StackedPosterior,
    default_candidates,
    stack,
)
from tests import gaussian
from tests.stacks import QUIET

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def gaussian_finetuned(rope: RoPE, seed: int) -> Any:
    method = FinetunedNPE.from_posterior(
        rope.npe,
        training=Training(
            training_batch_size=50, max_num_epochs=200, stop_after_epochs=50
        ),
        learning_rates=(5e-3,),
    )
    method.append_calibration(*rope.calibration)
    return method.train(seed=seed, **QUIET).build_posterior()


SETTINGS = (
    *default_candidates(gammas=(0.05, 0.2), taus=(1.0, 0.5))[:-1],
    DensityCandidate(name="fine-tuned NPE", build=gaussian_finetuned),
)


def gaussian_rope(theta: Tensor, x: Tensor) -> RoPE:
    finetuner = CalibrationFinetuner(learning_rate=1e-2, num_steps=200, patience=50)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=finetuner)
    return rope.append_calibration(theta, x).train(seed=0, **QUIET)


def gaussian_stack(
    theta: Tensor, x: Tensor, x_o: Tensor, *, seed: int = 0
) -> StackedPosterior:
    return stack(
        gaussian_rope(theta, x),
        x_o,
        candidates=SETTINGS,
        num_simulations=300,
        seed=seed,
        **QUIET,
    )


def mean_score(posterior: Any, theta: Tensor, x: Tensor) -> float:
    with torch.no_grad():
        return float(posterior.log_prob_batched(theta, x).double().mean())


def exact_score(theta: Tensor, x_s: Tensor) -> float:
    """Of the exact posterior given the simulations behind the observations."""
    return float(gaussian.exact_posterior(x_s).log_prob(theta).double().mean())


@pytest.mark.slow
def test_with_more_pairs_a_stack_approaches_the_exact_posterior() -> None:
    theta_o, x_o = gaussian.labelled(300)
    exact = exact_score(theta_o, gaussian.undo(x_o))
    missing = torch.zeros(2, 3)
    for row in missing:
        theta, x = gaussian.labelled(400)
        for k, n in enumerate((10, 50, 400)):
            posterior = gaussian_stack(theta[:n], x[:n], x_o)
            row[k] = exact - mean_score(posterior, theta_o, x_o)
    few, some, many = missing.mean(dim=0)
    assert few > some > many
    assert many < 0.1


@pytest.mark.slow
def test_held_out_scores_agree_with_scores_on_test_observations() -> None:
    theta_o, x_o = gaussian.labelled(300)
    away = []
    for repetition in range(8):
        posterior = gaussian_stack(*gaussian.labelled(40), x_o, seed=repetition)
        scores = posterior.report.cross_validation.stack_scores
        error = float(scores.std()) / len(scores) ** 0.5
        difference = float(scores.mean()) - mean_score(posterior, theta_o, x_o)
        away.append(difference / error)
    # In standard errors; the folds train on fewer pairs, which costs a little.
    assert sum(abs(z) < 2 for z in away) >= 6
    assert abs(sum(away) / 8) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 50])
def test_where_the_simulator_is_right_a_stack_loses_a_tenth_of_a_nat_at_most(
    n: int,
) -> None:
    """Against NPE, which is exact here; on average over observations."""
    theta_o = gaussian.prior().sample((300,))
    x_o = gaussian.simulator(theta_o)
    theta = gaussian.prior().sample((n,))
    posterior = gaussian_stack(theta, gaussian.simulator(theta), x_o)
    loss = exact_score(theta_o, x_o) - mean_score(posterior, theta_o, x_o)
    assert loss < 0.1


@pytest.mark.slow
def test_labels_that_say_nothing_make_a_stack_the_prior() -> None:
    theta_o, x_o = gaussian.labelled(300)
    theta, x = gaussian.labelled(50)
    posterior = gaussian_stack(theta.roll(1, dims=0), x, x_o)
    at_prior = float(gaussian.prior().log_prob(theta_o).mean())
    lost = at_prior - mean_score(posterior, theta_o, x_o)
    assert lost < 0.1


@pytest.mark.slow
def test_a_stack_is_calibrated_on_pairs_that_it_has_not_seen() -> None:
    _, x_o = gaussian.labelled(300)
    posterior = gaussian_stack(*gaussian.labelled(150), x_o)
    levels = posterior.report.cross_validation.levels().double()
    # Uniform, with four standard errors on the mean.
    assert ((levels.mean(dim=0) - 0.5).abs() < 4 / (12 * 150) ** 0.5).all()
    coverage = (levels < 0.9).double().mean(dim=0)
    assert ((coverage - 0.9).abs() < 0.1).all()
