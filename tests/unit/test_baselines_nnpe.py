"""NNPE: NPE that has seen errors in its statistics."""

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor

from sbi_rope.baselines import NNPE, PlainNPE, SpikeAndSlab
from sbi_rope.baselines.statistics import SoftClip
from sbi_rope.methods import Training
from sbi_rope.npe.sbi import embedding_of, estimator_of
from tests import problems
from tests.baselines import log_prob, train

PRIOR = problems.standard_normal(1)


def simulate(theta: Tensor, offset: float = 0.0) -> Tensor:
    """Five readings of theta with noise of sd 0.5 each; the first may be off."""
    x = theta + 0.5 * torch.randn(len(theta), 5)
    x[:, 0] += offset
    return x


def on_simulations(method: Any) -> Any:
    theta = PRIOR.sample(torch.Size((1500,)))
    return train(method.append_simulations(theta, simulate(theta))).build_posterior()


@functools.cache
def trained_npe() -> Any:
    torch.manual_seed(0)
    density = posterior_nn("mdn", hidden_features=50, num_components=4)
    training = Training(learning_rate=2e-3, max_num_epochs=30)
    return on_simulations(PlainNPE(PRIOR, density, npe_training=training))


@pytest.mark.slow
@pytest.mark.parametrize("noise_on", ["embedding", "input"])
def test_it_costs_little_where_the_simulator_is_right_and_gains_much_where_not(
    noise_on: Any,
) -> None:
    training = Training(learning_rate=2e-3, max_num_epochs=40)
    options: dict[str, Any] = {"noise_on": noise_on, "training": training}
    ours = on_simulations(NNPE.from_posterior(trained_npe(), **options))
    theta = PRIOR.sample(torch.Size((500,)))
    (right, right_npe), (wrong, wrong_npe) = (
        [float(log_prob(q, theta[None], x).mean()) for q in (ours, trained_npe())]
        for x in (simulate(theta), simulate(theta, 5.0))
    )
    # The price of doubting five readings, of which noise makes about half useless.
    assert -0.05 < right_npe - right < 0.3
    assert wrong > wrong_npe + 3.0
    # In absolute terms too: it has not merely fallen back to the prior.
    assert wrong > PRIOR.log_prob(theta).mean() + 0.3


@dataclass(frozen=True, kw_only=True)
class Recording(SpikeAndSlab):
    """The error model, with a memory of its draws."""

    draws: list[Tensor] = field(default_factory=list)

    def sample_like(self, x: Tensor) -> Tensor:
        self.draws.append(noise := super().sample_like(x))
        return noise


def small(**options: Any) -> Any:
    """A method that starts from a posterior of `problems`, after its training."""
    training = Training(max_num_epochs=2, training_batch_size=20)
    theta = problems.box(2).sample((200,))
    method = NNPE.from_posterior(problems.npe_posterior(), training=training, **options)
    return train(method.append_simulations(theta, problems.simulate(theta)))


def test_noise_is_drawn_anew_for_every_batch() -> None:
    model = Recording()
    method = small(error_model=model)
    # 180 pairs to train on and 20 to validate in every epoch, in batches of 20.
    assert len(model.draws) == len(method.history.validation_loss) * (9 + 1)
    assert len({noise.numpy().tobytes() for noise in model.draws}) == len(model.draws)


def test_noise_on_the_input_alone_trains_the_embedding_too() -> None:
    before = embedding_of(estimator_of(problems.npe_posterior())).state_dict()
    for noise_on, place in (("embedding", 0), ("input", 1)):
        posterior = small(noise_on=noise_on).build_posterior()
        net: Any = embedding_of(estimator_of(posterior))
        after = net[place].state_dict()
        same = all(torch.equal(before[name], after[name]) for name in before)
        assert same is (noise_on == "embedding")


def test_noise_is_in_units_of_the_statistics() -> None:
    """In other units of x the same posterior comes out, bit by bit if powers of two."""
    theta = PRIOR.sample(torch.Size((200,)))
    x, once, results = simulate(theta), Training(max_num_epochs=1), []
    density = posterior_nn("mdn", hidden_features=8)
    options: dict[str, Any] = {"npe_training": once, "training": once}
    for unit in (1.0, 1024.0):
        method = NNPE(PRIOR, density, noise_on="input", **options)
        posterior = train(method.append_simulations(theta, unit * x)).build_posterior()
        results.append(log_prob(posterior, theta[None, :9], unit * x[:9]))
    assert torch.allclose(results[0], results[1], atol=1e-5)


def test_the_network_sees_far_statistics_on_a_logarithmic_scale() -> None:
    simulated = 7.0 + 2.0 * torch.randn(1000, 1)
    mean, std = float(simulated.mean()), float(simulated.std())
    z = torch.tensor([-1000.0, -3.1, -3.0, 0.0, 2.9, 30.0])[:, None]
    seen = (SoftClip(simulated)(mean + std * z) - mean) / std
    far = [3 * (1 + math.log(size / 3)) for size in (1000, 3.1, 30)]
    expected = torch.tensor([-far[0], -far[1], -3.0, 0.0, 2.9, far[2]])
    assert torch.allclose(seen[:, 0], expected, atol=1e-3)
