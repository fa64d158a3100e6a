"""The corrected NPE, where the posterior can be computed by integration."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from sbi.neural_nets import posterior_nn
from scipy import stats
from torch import Tensor

from sbi_rope.baselines import PlainNPE
from sbi_rope.discrepancy import DiscrepancyDraws, DiscrepancyModel
from sbi_rope.methods import Training
from sbi_rope.methods.discrepancy_npe import DiscrepancyNPE
from sbi_rope.utils.seeds import seeded
from tests import gaussian

pytestmark = [
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:Capping max_sampling_batch_size"),
]

# theta ~ N(0, 1), x_s = theta + NOISE eps.
NOISE = 0.1
QUIET: dict[str, Any] = {"show_progress_bars": False}
TRAINING = Training(
    training_batch_size=200, learning_rate=5e-3, stop_after_epochs=5, max_num_epochs=30
)
# What may be wrong, not much narrower than the model's own grid.
MODEL = DiscrepancyModel(
    gain_precisions=(3.0, 10.0),
    error_scales=(0.2, 0.4),
    degrees_of_freedom=(3.0, 20.0),
    probability_of_none=0.0,
)


def simulator(theta: Tensor) -> Tensor:
    return theta + NOISE * torch.randn_like(theta)


class Reality(NamedTuple):
    """x_o = a theta + b + sd eps."""

    gain: float
    offset: float
    std: float

    def labelled(self, n: int) -> tuple[Tensor, Tensor]:
        theta = torch.randn(n, 1)
        return theta, self.gain * theta + self.offset + self.std * torch.randn(n, 1)


def reality(seed: int) -> Reality:
    """One that MODEL expects."""
    pick = np.random.default_rng(seed)
    k = pick.choice(MODEL.gain_precisions)
    s = pick.choice(MODEL.error_scales)
    strength = pick.choice(MODEL.degrees_of_freedom)
    rate = strength * s**2 / 2
    variance = stats.invgamma.rvs((strength + 2) / 2, scale=rate, random_state=pick)
    gain, offset = pick.normal(size=2) * (variance / k) ** 0.5 * np.array([1, 3**0.5])
    return Reality(1 + float(gain), float(offset), float(variance) ** 0.5)


@functools.cache
def npe() -> Any:
    """A well-trained NPE of the simulator, for reading only."""
    prior = gaussian.prior(1)
    builder = posterior_nn("mdn", hidden_features=20, num_components=2)
    with seeded(0):
        theta = prior.sample((5000,))
        method = PlainNPE(prior, builder, npe_training=TRAINING)
        method.append_simulations(theta, simulator(theta))
        return method.train(**QUIET).build_posterior()


def corrected(pairs: tuple[Tensor, Tensor], *, seed: int = 0, **options: Any) -> Any:
    """The posterior of DiscrepancyNPE, and the discrepancy."""
    options = {"model": MODEL, "num_simulations": 5000, **options}
    method = DiscrepancyNPE.from_posterior(npe(), simulator=simulator, **options)
    method.append_calibration(*pairs).train(seed=seed, **QUIET)
    return method.build_posterior(), method.discrepancy


THETA = torch.linspace(-5, 5, 201).double()


def marginal(x: Tensor, draws: DiscrepancyDraws) -> Tensor:
    """log p(theta | x, pairs) on THETA by integration, ``(201, n)``."""
    std = (1 + NOISE**2) ** 0.5
    z, m = x[:, 0].double() / std, THETA / std
    gain, offset = draws.gain[:, 0, 0], draws.offset[:, 0]
    variance = draws.error_factor[:, 0, 0] ** 2 + gain**2 * (NOISE / std) ** 2
    residual = z - (gain[:, None, None] * m[:, None] + offset[:, None, None])
    log_likelihood = -(residual**2) / (2 * variance[:, None, None])
    log_likelihood = log_likelihood - variance.log()[:, None, None] / 2
    joint = log_likelihood.logsumexp(dim=0) - THETA[:, None] ** 2 / 2
    return joint - joint.logsumexp(dim=0) - math.log(float(THETA[1] - THETA[0]))


@pytest.mark.medium
@pytest.mark.parametrize(
    ("num_pairs", "space"),
    [(4, "embedding"), pytest.param(50, "input", marks=pytest.mark.slow)],
)
def test_the_posterior_is_that_with_the_discrepancy_integrated_out(
    num_pairs: int, space: str
) -> None:
    real = Reality(0.7, 0.5, 0.3)
    pairs = real.labelled(num_pairs)
    posterior, discrepancy = corrected(pairs, space=space)
    draws = discrepancy.sample(1000, seed=1)
    x = real.labelled(40)[1]
    expected = marginal(x, draws)
    grid = THETA.float()[:, None, None].expand(-1, 40, 1)
    log_q = posterior.log_prob_batched(grid, x, norm_posterior=False).double()
    step = float(THETA[1] - THETA[0])
    divergence = (expected.exp() * (expected - log_q) * step).sum(dim=0)
    assert float(divergence.mean()) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("num_pairs", [5, 50])
def test_intervals_of_90_percent_hold_90_percent_of_the_parameters(
    num_pairs: int,
) -> None:
    shares = []
    for repetition in range(60):
        real = reality(repetition)
        with seeded(1000 + repetition):
            pairs, (theta, x) = real.labelled(num_pairs), real.labelled(400)
        posterior, _ = corrected(pairs, seed=repetition)
        with seeded(repetition):
            samples = posterior.sample_batched(
                (400,), x, reject_outside_prior=False, **QUIET
            )
        below = (samples < theta).double().mean(dim=0)[:, 0]
        shares.append(float(((below > 0.05) & (below < 0.95)).double().mean()))
    error = float(np.std(shares)) / len(shares) ** 0.5
    assert error < 0.02
    assert abs(float(np.mean(shares)) - 0.9) < 3 * error + 0.005
