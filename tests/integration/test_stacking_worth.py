"""The density of a stack, where the exact posterior is known."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE
from sbi_rope.stacking import StackedPosterior, default_candidates, stack
from tests import gaussian
from tests.stacks import QUIET

# Batches and calibration sets are small here on purpose.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning"),
]


def labelled(n: int, process: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    theta = gaussian.prior().sample((n,))
    return theta, process(theta)


def gaussian_stack(theta: Tensor, x: Tensor, *, seed: int = 0) -> StackedPosterior:
    """Of all default candidates but those that correct x."""
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.append_calibration(theta, x)
    # Correcting x would take most of the time, and adds nothing: h is a bijection here.
    candidates = [c for c in default_candidates() if "(input)" not in c.name]
    return stack(rope, candidates=candidates, seed=seed, **QUIET)


def score_of(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    with torch.no_grad():
        return posterior.log_prob_batched(theta, x).double().flatten()


def test_a_stack_beats_npe_and_prior_and_approaches_the_exact_posterior() -> None:
    theta_o, x_o = labelled(300, gaussian.real_process)
    at_prior = gaussian.prior().log_prob(theta_o).mean()
    npe = score_of(gaussian.posterior(), theta_o, x_o).mean()
    exact = gaussian.exact_posterior(gaussian.undo(x_o)).log_prob(theta_o).mean()
    theta, x = labelled(200, gaussian.real_process)
    few, many = (gaussian_stack(theta[:n], x[:n]) for n in (50, 200))
    missing = [float(exact - score_of(one, theta_o, x_o).mean()) for one in (few, many)]
    assert missing[0] < min(0.25, float(exact - max(at_prior, npe)) - 0.5)
    assert missing[1] < 0.1
    # And it says so.
    assert all(gain.low > 0 for gain in few.report.gains.values())
    assert {*few.report.gains} == {"prior", "NPE"}
    levels = many.report.held_out.levels.double()
    # Calibrated levels are uniform. There are four standard errors on their mean.
    assert ((levels.mean(dim=0) - 0.5).abs() < 4 / (12 * 200) ** 0.5).all()


def test_where_the_simulator_is_right_a_stack_loses_less_than_a_twentieth_nat() -> None:
    """Which is exact here; on average over observations and two sets of pairs."""
    theta_o, x_o = labelled(300, gaussian.simulator)
    exact = float(gaussian.exact_posterior(x_o).log_prob(theta_o).mean())
    lost = []
    for seed in range(2):
        posterior = gaussian_stack(*labelled(50, gaussian.simulator), seed=seed)
        lost.append(exact - float(score_of(posterior, theta_o, x_o).mean()))
    assert sum(lost) / 2 < 0.05


def test_shuffled_labels_make_a_stack_almost_the_prior() -> None:
    theta_o, x_o = labelled(300, gaussian.real_process)
    theta, x = labelled(50, gaussian.real_process)
    posterior = gaussian_stack(theta.roll(1, dims=0), x)
    at_prior = gaussian.prior().log_prob(theta_o)
    assert float((at_prior - score_of(posterior, theta_o, x_o)).mean()) < 0.1


def test_held_out_scores_promise_no_more_than_test_observations_give() -> None:
    """On average over draws of the pairs."""
    promised, given = [], []
    for seed in range(4):
        theta_o, x_o = labelled(300, gaussian.real_process)
        theta, x = labelled(30, gaussian.real_process)
        posterior = gaussian_stack(theta, x, seed=seed)
        promised.append(posterior.report.held_out.log_prob)
        given.append(score_of(posterior, theta_o, x_o))
    both = torch.cat(promised), torch.cat(given)
    gap = both[0].mean() - both[1].mean()
    error = math.hypot(*(float(one.std()) / len(one) ** 0.5 for one in both))
    # It may be pessimistic: what is deployed averages over versions.
    assert float(gap) < 2 * error
    assert float(gap) > -2 * error - 0.3
