"""Baselines that train one density, and the parts of RoPE: what each of them learns."""

import functools
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.baselines import (
    CalibrationMLP,
    JointNPE,
    OTOnly,
    PlainNPE,
    ReferenceNPE,
    TuningOnly,
)
from sbi_rope.baselines.calibration_mlp import DiagonalGaussian
from sbi_rope.methods import FinetunedNPE, Method, Training
from sbi_rope.tasks import get_task
from tests import problems
from tests.baselines import log_prob, train

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of epochs")

TASK: Any = get_task("linear_gaussian")
SHORT = Training(training_batch_size=50, max_num_epochs=2)
LONG = Training(
    training_batch_size=100,
    learning_rate=5e-3,
    validation_fraction=0.2,
    stop_after_epochs=15,
    max_num_epochs=40,
)


def builder(net: nn.Module | None = None) -> Any:
    """One Gaussian with a full covariance, at a linear function of x unless given."""
    net = nn.Linear(2, 4) if net is None else net
    return posterior_nn("mdn", embedding_net=net, hidden_features=16, num_components=1)


@functools.cache
def npe(n: int = 2000, training: Training = LONG) -> Any:
    """A trained NPE, for reading only."""
    method = PlainNPE(TASK.get_prior(), builder(), npe_training=training)
    return train(method.append_simulations(*TASK.get_simulations(n)))


@pytest.mark.slow
class TestWithPlentyOfPairs:
    """Trained on 2400 pairs of the real process, scored on 1000 others."""

    NUM_PAIRS = 2400

    def loss_of(self, method: Method) -> float:
        """Nats between the mean log density and that of the exact posterior."""
        pairs = TASK.get_calibration_set(self.NUM_PAIRS + 1000)
        theta, x = (rows[self.NUM_PAIRS :] for rows in pairs)
        exact = TASK.get_true_posterior(x).log_prob(theta.double()).mean()
        return float(exact - log_prob(method.build_posterior(), theta[None], x).mean())

    @pytest.mark.filterwarnings("error::sbi_rope.utils.errors.RoPEWarning")
    def test_npe_stays_wrong_but_is_right_where_its_simulator_is(self) -> None:
        assert self.loss_of(npe()) > 2
        theta, simulator = TASK.get_test_set(1000)[0], TASK.get_simulator()
        theta, x = ReferenceNPE.simulated_test_set(npe(), theta, simulator)
        exact = simulator.posterior(x).log_prob(theta.double()).mean()
        scored = log_prob(npe().build_posterior(), theta[None], x).mean()
        assert abs(float(exact - scored)) < 0.05

    def test_finetuned_npe_comes_within_three_hundredths_of_a_nat(self) -> None:
        method = FinetunedNPE.from_posterior(
            npe().build_posterior(), training=LONG, learning_rates=(5e-3,)
        )
        method.append_calibration(*TASK.get_calibration_set(self.NUM_PAIRS))
        assert abs(self.loss_of(train(method))) < 0.03

    def test_joint_npe_comes_within_a_quarter_of_a_nat(self) -> None:
        """Its posterior is shared between real observations and simulations.

        With a linear embedding they cannot be told apart; the mixture of both is what
        even many pairs lead to.
        """
        net = nn.Sequential(nn.Linear(2, 32), nn.ReLU(), nn.Linear(32, 8))
        method = JointNPE(TASK.get_prior(), builder(net), training=LONG)
        method.append_simulations(*TASK.get_simulations(1000))
        method.append_calibration(*TASK.get_calibration_set(self.NUM_PAIRS))
        assert abs(self.loss_of(train(method))) < 0.25

    def test_the_mlp_comes_as_close_as_a_diagonal_gaussian_can(self) -> None:
        """To 0.03 nats; the best one has the marginal variances of the exact one."""
        method = CalibrationMLP(TASK.get_prior(), builder(), training=LONG)
        method.append_calibration(*TASK.get_calibration_set(self.NUM_PAIRS))
        covariance = TASK.get_true_posterior(torch.zeros(1, 2)).covariance_matrix[0]
        best = covariance.diag().prod().log() - covariance.logdet()
        assert self.loss_of(train(method)) == pytest.approx(0.5 * float(best), abs=0.03)


def mlp() -> tuple[DiagonalGaussian, Any]:
    """An estimator of two parameters given three readings, and its law."""
    net = nn.Linear(3, 4)
    mean, std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0])

    def law(x: Tensor) -> Distribution:
        mu, log_variance = net(x).split(2, dim=1)
        variance = log_variance.exp()
        scale = std * (25 * variance / (25 + variance)).sqrt()
        return Independent(Normal(mean + std * 5 * torch.tanh(mu / 5), scale), 1)

    return DiagonalGaussian(net, mean, std, torch.Size((3,))), law


def test_the_density_of_the_mlp_is_the_stated_one() -> None:
    estimator, law = mlp()
    x, theta = torch.randn(5, 3), torch.randn(7, 5, 2)
    expected = law(x).log_prob(theta)
    assert torch.allclose(estimator.log_prob(theta, x), expected, atol=1e-5)
    assert torch.allclose(-estimator.loss(theta[0], x), expected[0], atol=1e-5)


def test_the_mlp_is_never_surer_than_a_tenth_of_its_error_nor_outside_the_prior() -> (
    None
):
    estimator, law = mlp()
    x = torch.randn(2000, 3)
    # Off by 20, that is by 40 and by 20 / 3 standard deviations of the prior.
    theta = law(x).mean + 20 * torch.randn(2000, 2)
    before = law(x).stddev
    estimator.set_bounds(theta, x, 3 * torch.randn(100, 2))
    expected = (before.square() + 2.0**2).sqrt()
    assert torch.allclose(estimator.law(x).stddev, expected, rtol=0.05)
    far = estimator.law(1e6 * torch.randn(50, 3))
    assert far.mean.abs().max() < 15
    assert (far.log_prob(torch.tensor([1.0, -2.0])) > -1e4).all()


@pytest.mark.filterwarnings("ignore:2 of the 2 entries")
def test_each_batch_of_joint_npe_is_half_simulations_and_half_pairs_to_train_on() -> (
    None
):
    """Seen by a net that counts: real observations are marked by their size."""
    seen: list[tuple[int, int]] = []
    pairs: set[tuple[float, ...]] = set()

    class Counter(nn.Linear):
        def forward(self, x: Tensor) -> Tensor:
            if self.training and torch.is_grad_enabled() and len(x) > 1:
                is_real = (x.abs() > 50).all(dim=1)
                seen.append((len(x), int(is_real.sum())))
                pairs.update(tuple(row) for row in x[is_real].tolist())
            return super().forward(x)

    training = Training(training_batch_size=20, max_num_epochs=2)
    method = JointNPE(TASK.get_prior(), builder(Counter(2, 2)), training=training)
    method.append_simulations(*TASK.get_simulations(65))
    theta, x = TASK.get_calibration_set(20)
    train(method.append_calibration(theta, x + 1000))
    assert sorted(seen) == 2 * [(10, 5)] + 12 * [(20, 10)]
    assert len(pairs) == 18  # two are held out


# The parts of RoPE.

SOURCES: list[dict[str, Any]] = [
    {"simulator": TASK.get_simulator()},
    {"simulations": TASK.get_simulations(100)},
]


@pytest.mark.parametrize("source", SOURCES, ids=["simulator", "stored"])
def test_its_ablations_are_rope_itself(source: dict[str, Any]) -> None:
    given = npe(100, SHORT).build_posterior()
    finetuner = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=10)
    coupler = SinkhornCoupler(gamma=0.8, tau=0.9)
    theta, (_, x_o) = torch.randn(1, 7, 2), TASK.get_test_set(30)
    rope = RoPE(given, finetuner=finetuner, coupler=coupler, **source)
    stored = source.get("simulations")

    def made(kind: type[Method], **options: Any) -> Method:
        if stored:
            method = kind.from_posterior(given, **options)
            return method.append_simulations(*stored)
        return kind.from_posterior(given, **options, **source)

    # Transport without tuning.
    method = made(OTOnly, num_simulations=50, coupler=coupler)
    mixture = train(method.append_observations(x_o)).build_posterior()
    expected = rope.build_posterior(x_o, num_simulations=50, seed=0)
    assert torch.equal(mixture.weights, expected.weights)
    found, expected = (log_prob(one, theta, x_o[:7]) for one in (mixture, expected))
    assert torch.equal(found, expected)
    # Tuning without transport.
    pairs = TASK.get_calibration_set(20)
    rope.append_calibration(*pairs).train(seed=0, show_progress_bars=False)
    tuned = made(TuningOnly, finetuner=finetuner)
    posterior = train(tuned.append_calibration(*pairs)).build_posterior()
    expected = log_prob(rope.tuned_posterior(), theta, x_o[:7])
    assert torch.equal(log_prob(posterior, theta, x_o[:7]), expected)
    assert tuned.history == rope.history


@pytest.mark.parametrize("family", ["fmpe", "npse"])
def test_npe_given_beforehand_may_be_a_vector_field(family: str) -> None:
    posterior = problems.vector_field_posterior(family)
    built = train(PlainNPE.from_posterior(posterior)).build_posterior()
    assert type(built) is type(posterior)
    assert built is not posterior


def test_an_option_that_a_method_has_no_use_for_is_refused() -> None:
    for kind, option in [
        (PlainNPE, {"training": SHORT}),
        (JointNPE, {"npe_training": SHORT}),
        (JointNPE, {"simulator": TASK.get_simulator()}),
    ]:
        with pytest.raises(TypeError, match="has no use for"):
            kind(TASK.get_prior(), **option)  # type: ignore[arg-type]
