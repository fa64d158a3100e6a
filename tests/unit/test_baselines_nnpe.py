"""NNPE: NPE that has seen errors in its statistics."""

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_rope.baselines import NNPE, PlainNPE, SpikeAndSlab, Training
from sbi_rope.baselines.statistics import SoftClip
from sbi_rope.metrics import evaluate
from sbi_rope.npe.sbi import embedding_of, estimator_of
from tests import problems

QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}
PRIOR = Independent(Normal(torch.zeros(1), torch.ones(1)), 1)


def simulate(theta: Tensor, offset: float = 0.0) -> Tensor:
    """Five readings of theta with noise of sd 0.5 each; the first may be off."""
    x = theta + 0.5 * torch.randn(len(theta), 5)
    x[:, 0] += offset
    return x


@functools.cache
def trained_npe() -> Any:
    torch.manual_seed(0)
    theta = PRIOR.sample(torch.Size((1500,)))
    method = PlainNPE(
        PRIOR,
        posterior_nn("mdn", hidden_features=50, num_components=4),
        npe_training=Training(learning_rate=2e-3, max_num_epochs=30),
    )
    method.append_simulations(theta, simulate(theta))
    return method.train(**QUIET).build_posterior()


@functools.cache
def trained_nnpe(noise_on: str) -> Any:
    torch.manual_seed(1)
    theta = PRIOR.sample(torch.Size((1500,)))
    method = NNPE.from_posterior(
        trained_npe(),
        noise_on=noise_on,
        training=Training(learning_rate=2e-3, max_num_epochs=40),
    )
    method.append_simulations(theta, simulate(theta))
    return method.train(**QUIET).build_posterior()


def small(posterior: Any, **options: Any) -> NNPE:
    """A method that starts from a posterior of `problems`, after its training."""
    training = Training(max_num_epochs=2, training_batch_size=20)
    theta = problems.box(2).sample((200,))
    method = NNPE.from_posterior(posterior, training=training, **options)
    return method.append_simulations(theta, problems.simulate(theta)).train(**QUIET)


@pytest.mark.slow
@pytest.mark.parametrize("noise_on", ["embedding", "input"])
def test_it_costs_little_where_the_simulator_is_right_and_gains_much_where_not(
    noise_on: str,
) -> None:
    theta = PRIOR.sample(torch.Size((500,)))
    scores = {
        (offset, name): evaluate(
            posterior, theta, simulate(theta, offset), num_samples=20
        ).lpp.mean
        for offset in (0.0, 5.0)
        for name, posterior in (
            ("npe", trained_npe()),
            ("ours", trained_nnpe(noise_on)),
        )
    }
    # The price of doubting five readings, of which noise makes about half useless.
    assert -0.05 < scores[0.0, "npe"] - scores[0.0, "ours"] < 0.3
    assert scores[5.0, "ours"] > scores[5.0, "npe"] + 3.0
    # In absolute terms too: it has not merely fallen back to the prior.
    assert scores[5.0, "ours"] > PRIOR.log_prob(theta).mean() + 0.3


@dataclass(frozen=True, kw_only=True)
class Recording(SpikeAndSlab):
    """The error model, with a memory of its draws."""

    draws: list[Tensor] = field(default_factory=list)

    def sample_like(self, x: Tensor) -> Tensor:
        self.draws.append(noise := super().sample_like(x))
        return noise


def test_noise_is_drawn_anew_for_every_batch() -> None:
    model = Recording()
    method = small(problems.npe_posterior(), error_model=model)
    # 180 pairs to train on and 20 to validate in every epoch, in batches of 20.
    assert len(model.draws) == len(method.history.validation_loss) * (9 + 1)
    assert len({noise.numpy().tobytes() for noise in model.draws}) == len(model.draws)


def test_noise_on_the_input_alone_trains_the_embedding_too() -> None:
    npe = problems.npe_posterior()
    before = embedding_of(estimator_of(npe)).state_dict()
    for noise_on, place in (("embedding", 0), ("input", 1)):
        posterior = small(npe, noise_on=noise_on).build_posterior()
        net: Any = embedding_of(estimator_of(posterior))
        after = net[place].state_dict()
        same = all(torch.equal(before[name], after[name]) for name in before)
        assert same is (noise_on == "embedding")


def test_noise_is_in_units_of_the_statistics() -> None:
    """In other units of x the same posterior comes out, bit by bit if powers of two."""
    theta = PRIOR.sample(torch.Size((200,)))
    x, once, results = simulate(theta), Training(max_num_epochs=1), []
    for unit in (1.0, 1024.0):
        method = NNPE(
            PRIOR,
            posterior_nn("mdn", hidden_features=8),
            noise_on="input",
            npe_training=once,
            training=once,
        )
        posterior = method.append_simulations(theta, unit * x).train(**QUIET)
        results.append(
            posterior.build_posterior().log_prob_batched(theta[:9], x=unit * x[:9])
        )
    assert torch.allclose(results[0], results[1], atol=1e-5)


def test_the_network_sees_far_statistics_on_a_logarithmic_scale() -> None:
    simulated = 7.0 + 2.0 * torch.randn(1000, 1)
    mean, std = float(simulated.mean()), float(simulated.std())
    z = torch.tensor([-1000.0, -3.1, -3.0, 0.0, 2.9, 30.0])[:, None]
    seen = (SoftClip(simulated)(mean + std * z) - mean) / std
    far = [3 * (1 + math.log(size / 3)) for size in (1000, 3.1, 30)]
    expected = torch.tensor([-far[0], -far[1], -3.0, 0.0, 2.9, far[2]])
    assert torch.allclose(seen[:, 0], expected, atol=1e-3)
