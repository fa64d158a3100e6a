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
    FinetunedNPE,
    JointNPE,
    Method,
    OTOnly,
    PlainNPE,
    ReferenceNPE,
    Training,
    TuningOnly,
)
from sbi_rope.baselines.calibration_mlp import DiagonalGaussian
from sbi_rope.tasks import get_task
from tests import problems

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
QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}


def builder(net: nn.Module | None = None) -> Any:
    """One Gaussian with a full covariance, at a linear function of x unless given."""
    net = nn.Linear(2, 4) if net is None else net
    return posterior_nn("mdn", embedding_net=net, hidden_features=16, num_components=1)


def simulations(n: int = 100) -> tuple[Tensor, Tensor]:
    return TASK.get_simulations(n)


def real(n: int = 20) -> tuple[Tensor, Tensor]:
    return TASK.get_calibration_set(n)


@functools.cache
def npe(n: int = 2000, training: Training = LONG) -> Any:
    """A trained NPE, for reading only."""
    method = PlainNPE(TASK.get_prior(), builder(), npe_training=training)
    return method.append_simulations(*simulations(n)).train(**QUIET)


def quick_posterior() -> Any:
    return npe(100, SHORT).build_posterior()


def log_probs(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    return posterior.log_prob_batched(theta[None], x, norm_posterior=False)[0]


@pytest.mark.slow
class TestWithPlentyOfPairs:
    """Trained on 2400 pairs of the real process, scored on 1000 others."""

    NUM_PAIRS = 2400

    def loss_of(self, method: Method) -> float:
        """Nats between the mean log density and that of the exact posterior."""
        theta, x = real(self.NUM_PAIRS + 1000)
        theta, x = theta[self.NUM_PAIRS :], x[self.NUM_PAIRS :]
        exact = TASK.get_true_posterior(x).log_prob(theta.double()).mean()
        return float(exact - log_probs(method.build_posterior(), theta, x).mean())

    @pytest.mark.filterwarnings("error::sbi_rope.utils.errors.RoPEWarning")
    def test_npe_stays_wrong_but_is_right_where_its_simulator_is(self) -> None:
        assert self.loss_of(npe()) > 2
        theta, simulator = TASK.get_test_set(1000)[0], TASK.get_simulator()
        theta, x = ReferenceNPE.simulated_test_set(npe(), theta, simulator)
        exact = simulator.posterior(x).log_prob(theta.double()).mean()
        scored = log_probs(npe().build_posterior(), theta, x).mean()
        assert abs(float(exact - scored)) < 0.05

    def test_finetuned_npe_comes_within_three_hundredths_of_a_nat(self) -> None:
        method = FinetunedNPE.from_posterior(
            npe().build_posterior(), training=LONG, learning_rates=(5e-3,)
        )
        method.append_calibration(*real(self.NUM_PAIRS)).train(**QUIET)
        assert abs(self.loss_of(method)) < 0.03

    def test_joint_npe_comes_within_a_quarter_of_a_nat(self) -> None:
        """Its posterior is shared between real observations and simulations.

        With a linear embedding they cannot be told apart; the mixture of both is what
        even many pairs lead to.
        """
        net = nn.Sequential(nn.Linear(2, 32), nn.ReLU(), nn.Linear(32, 8))
        method = JointNPE(TASK.get_prior(), builder(net), training=LONG)
        method.append_simulations(*simulations(1000))
        method.append_calibration(*real(self.NUM_PAIRS)).train(**QUIET)
        assert abs(self.loss_of(method)) < 0.25

    def test_the_mlp_comes_as_close_as_a_diagonal_gaussian_can(self) -> None:
        """To 0.03 nats; the best one has the marginal variances of the exact one."""
        method = CalibrationMLP(TASK.get_prior(), builder(), training=LONG)
        method.append_calibration(*real(self.NUM_PAIRS)).train(**QUIET)
        covariance = TASK.get_true_posterior(torch.zeros(1, 2)).covariance_matrix[0]
        best = covariance.diag().prod().log() - covariance.logdet()
        assert self.loss_of(method) == pytest.approx(0.5 * float(best), abs=0.03)


class TestCalibrationMLP:
    def estimator(self) -> tuple[DiagonalGaussian, Any]:
        net = nn.Linear(3, 4)
        mean, std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0])
        estimator = DiagonalGaussian(net, mean, std, torch.Size((3,)))

        def law(x: Tensor) -> Distribution:
            mu, log_variance = net(x).split(2, dim=1)
            variance = log_variance.exp()
            scale = std * (25 * variance / (25 + variance)).sqrt()
            return Independent(Normal(mean + std * 5 * torch.tanh(mu / 5), scale), 1)

        return estimator, law

    def test_its_density_is_the_stated_one(self) -> None:
        estimator, law = self.estimator()
        x, theta = torch.randn(5, 3), torch.randn(7, 5, 2)
        expected = law(x).log_prob(theta)
        assert torch.allclose(estimator.log_prob(theta, x), expected, atol=1e-5)
        assert torch.allclose(-estimator.loss(theta[0], x), expected[0], atol=1e-5)

    def test_it_is_never_surer_than_a_tenth_of_its_error_nor_outside_the_prior(
        self,
    ) -> None:
        estimator, law = self.estimator()
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


class TestJointNPE:
    def test_each_batch_is_half_simulations_and_half_pairs_of_those_to_train_on(
        self,
    ) -> None:
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

        method = JointNPE(
            TASK.get_prior(),
            builder(Counter(2, 2)),
            training=Training(training_batch_size=20, max_num_epochs=2),
        )
        method.append_simulations(*simulations(65))
        theta, x = real(20)
        method.append_calibration(theta, x + 1000).train(**QUIET)
        assert sorted(seen) == 2 * [(10, 5)] + 12 * [(20, 10)]
        assert len(pairs) == 18  # two are held out


@pytest.mark.parametrize("stored", [True, False])
class TestRoPEsParts:
    """The two ablations are RoPE itself."""

    THETA, X = torch.randn(7, 2), torch.randn(7, 2)

    def test_tuning_only_is_ropes_tuned_posterior(self, stored: bool) -> None:
        options: dict[str, Any] = {
            "finetuner": CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=10),
            **source(stored=stored),
        }
        rope = RoPE(quick_posterior(), **options)
        rope.append_calibration(*real()).train(**QUIET)
        stored_pairs = options.pop("simulations", None)
        method = TuningOnly.from_posterior(quick_posterior(), **options)
        if stored_pairs:
            method.append_simulations(*stored_pairs)
        method.append_calibration(*real()).train(**QUIET)
        expected = log_probs(rope.tuned_posterior(), self.THETA, self.X)
        scored = log_probs(method.build_posterior(), self.THETA, self.X)
        assert torch.equal(scored, expected)
        assert method.history == rope.history

    def test_ot_only_is_rope_without_calibration(self, stored: bool) -> None:
        options: dict[str, Any] = {
            "coupler": SinkhornCoupler(gamma=0.8, tau=0.9),
            **source(stored=stored),
        }
        _, x_o = TASK.get_test_set(30)
        rope = RoPE(quick_posterior(), **options)
        expected = rope.build_posterior(x_o, num_simulations=50, seed=0)
        stored_pairs = options.pop("simulations", None)
        method = OTOnly.from_posterior(quick_posterior(), num_simulations=50, **options)
        if stored_pairs:
            method.append_simulations(*stored_pairs)
        mixture = method.append_observations(x_o).train(**QUIET).build_posterior()
        assert torch.equal(mixture.weights, expected.weights)
        assert torch.equal(
            mixture.log_prob_batched(self.THETA[None], x_o[:7]),
            expected.log_prob_batched(self.THETA[None], x_o[:7]),
        )


def source(*, stored: bool) -> dict[str, Any]:
    if stored:
        return {"simulations": simulations()}
    return {"simulator": TASK.get_simulator()}


@pytest.mark.parametrize("family", ["fmpe", "npse"])
def test_npe_given_beforehand_may_be_a_vector_field(family: str) -> None:
    posterior = problems.vector_field_posterior(family)
    built = PlainNPE.from_posterior(posterior).train(**QUIET).build_posterior()
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
