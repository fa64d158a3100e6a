"""NNPE: NPE that has seen errors in its statistics."""

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from sbi_rope._sbi import embedding_of, estimator_of
from sbi_rope.baselines.error_model import SpikeAndSlab
from sbi_rope.baselines.nnpe import NNPE
from sbi_rope.baselines.npe import PlainNPE
from sbi_rope.baselines.statistics import SoftClip
from sbi_rope.metrics import lpp
from sbi_rope.trainers.training import Training
from tests import problems

ONCE = Training(max_num_epochs=1, training_batch_size=50)
NUM_READINGS = 5


def prior() -> Independent:
    return Independent(Normal(torch.zeros(1), torch.ones(1)), 1)


def simulate(theta: Tensor) -> Tensor:
    """Five readings of theta with noise of sd 0.5 each."""
    return theta + 0.5 * torch.randn(len(theta), NUM_READINGS)


def misspecified(theta: Tensor) -> Tensor:
    """The first reading is off by ten standard deviations of its noise."""
    x = simulate(theta)
    x[:, 0] += 5.0
    return x


@functools.cache
def trained_npe() -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        theta = prior().sample(torch.Size((1500,)))
        method = PlainNPE(
            prior(),
            posterior_nn("mdn", hidden_features=50, num_components=4),
            npe_training=Training(learning_rate=2e-3, max_num_epochs=30),
        )
        method.append_simulations(theta, simulate(theta))
        return method.train(seed=0, show_progress_bars=False).build_posterior()


@functools.cache
def trained_nnpe(noise_on: str) -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        theta = prior().sample(torch.Size((1500,)))
        method = NNPE.from_posterior(
            trained_npe(),
            noise_on=noise_on,
            training=Training(learning_rate=2e-3, max_num_epochs=40),
        )
        method.append_simulations(theta, simulate(theta))
        return method.train(seed=0, show_progress_bars=False).build_posterior()


def small(posterior: Any, **options: Any) -> NNPE:
    """A method that starts from a posterior of `problems`, with simulations."""
    options = {"training": ONCE, **options}
    theta = problems.box(2).sample((200,))
    method = NNPE.from_posterior(posterior, **options)
    return method.append_simulations(theta, problems.simulate(theta))


def state_of(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@dataclass(frozen=True, kw_only=True)
class Recording(SpikeAndSlab):
    """The error model, with a memory of its draws."""

    draws: list[Tensor] = field(default_factory=list)

    def sample_like(self, x: Tensor) -> Tensor:
        noise = super().sample_like(x)
        self.draws.append(noise)
        return noise


# --- behaviour ---


@pytest.mark.parametrize("noise_on", ["embedding", "input"])
@pytest.mark.slow
def test_with_a_right_simulator_it_stays_near_npe(noise_on: str) -> None:
    theta = prior().sample(torch.Size((500,)))
    x = simulate(theta)
    loss = (
        lpp(trained_npe(), theta, x).mean - lpp(trained_nnpe(noise_on), theta, x).mean
    )
    # The price of doubting five readings, of which noise makes about half useless.
    assert -0.05 < loss < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("noise_on", ["embedding", "input"])
def test_with_one_wrong_statistic_it_is_far_better_than_npe(noise_on: str) -> None:
    theta = prior().sample(torch.Size((500,)))
    x = misspecified(theta)
    gain = (
        lpp(trained_nnpe(noise_on), theta, x).mean - lpp(trained_npe(), theta, x).mean
    )
    assert gain > 3.0
    # In absolute terms too: it has not merely fallen back to the prior.
    assert (
        lpp(trained_nnpe(noise_on), theta, x).mean
        > prior().log_prob(theta).mean() + 0.3
    )


# --- training ---


def test_noise_is_drawn_anew_for_every_batch() -> None:
    model = Recording()
    training = Training(max_num_epochs=2, training_batch_size=20)
    method = small(problems.npe_posterior(), error_model=model, training=training)
    method.train(seed=0, show_progress_bars=False)
    # 180 pairs to train on and 20 to validate in every epoch, in batches of 20.
    assert len(model.draws) == len(method.history.validation_loss) * (9 + 1)
    assert len({noise.numpy().tobytes() for noise in model.draws}) == len(model.draws)


def test_noise_on_the_input_alone_trains_the_embedding_too() -> None:
    npe = problems.npe_posterior()
    before = state_of(embedding_of(estimator_of(npe)))
    for noise_on, place in (("embedding", 0), ("input", 1)):
        method = small(npe, noise_on=noise_on).train(seed=0, show_progress_bars=False)
        net: Any = embedding_of(estimator_of(method.build_posterior()))
        assert equal(before, state_of(net[place])) is (noise_on == "embedding")


def test_noise_is_in_units_of_the_statistics() -> None:
    """In other units of x the same posterior comes out, bit by bit if powers of two."""
    theta = prior().sample(torch.Size((200,)))
    x = simulate(theta)
    results = []
    for unit in (1.0, 1024.0):
        method = NNPE(
            prior(),
            posterior_nn("mdn", hidden_features=8),
            noise_on="input",
            npe_training=ONCE,
            training=ONCE,
        )
        method.append_simulations(theta, unit * x)
        posterior = method.train(seed=0, show_progress_bars=False).build_posterior()
        results.append(posterior.log_prob_batched(theta[:9], x=unit * x[:9]))
    assert torch.allclose(results[0], results[1], atol=1e-5)


def test_the_network_sees_far_statistics_on_a_logarithmic_scale() -> None:
    simulated = 7.0 + 2.0 * torch.randn(1000, 1)
    clip = SoftClip(simulated)
    mean, std = float(simulated.mean()), float(simulated.std())
    z = torch.tensor([-1000.0, -3.1, -3.0, 0.0, 2.9, 30.0])[:, None]
    seen = (clip(mean + std * z) - mean) / std
    expected = [
        -3 * (1 + math.log(1000 / 3)),
        -3 * (1 + math.log(3.1 / 3)),
        -3.0,
        0.0,
        2.9,
        3 * (1 + math.log(10)),
    ]
    assert torch.allclose(seen[:, 0], torch.tensor(expected), atol=1e-3)
