"""The simple baselines: what they become with plenty of data, and what they refuse."""

import functools
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope._random import seeded
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
from sbi_rope.errors import NotReadyError
from sbi_rope.tasks import get_task
from tests import gaussian, problems

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
def npe() -> Any:
    """A well-trained NPE, for reading only."""
    method = PlainNPE(TASK.get_prior(), builder(), npe_training=LONG)
    return method.append_simulations(*simulations(2000)).train(**QUIET)


@functools.cache
def quick_npe() -> Any:
    """An NPE that is hardly trained, for reading only."""
    method = PlainNPE(TASK.get_prior(), builder(), npe_training=SHORT)
    return method.append_simulations(*simulations()).train(**QUIET)


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

    @pytest.mark.filterwarnings("error::sbi_rope.errors.RoPEWarning")
    def test_npe_stays_wrong(self) -> None:
        assert self.loss_of(npe()) > 2

    def test_npe_is_right_where_its_simulator_is(self) -> None:
        theta, x = ReferenceNPE.simulated_test_set(npe(), *self.fresh())
        exact = TASK.get_simulator().posterior(x).log_prob(theta.double()).mean()
        scored = log_probs(npe().build_posterior(), theta, x).mean()
        assert abs(float(exact - scored)) < 0.05

    def fresh(self) -> tuple[Tensor, Any]:
        return TASK.get_test_set(1000)[0], TASK.get_simulator()

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


class TestDiagonalGaussian:
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

    def test_its_density_is_that_of_torch(self) -> None:
        estimator, law = self.estimator()
        x, theta = torch.randn(5, 3), torch.randn(7, 5, 2)
        expected = law(x).log_prob(theta)
        assert torch.allclose(estimator.log_prob(theta, x), expected, atol=1e-5)
        assert torch.allclose(-estimator.loss(theta[0], x), expected[0], atol=1e-5)

    def test_it_is_never_surer_than_a_tenth_of_its_error(self) -> None:
        estimator, law = self.estimator()
        x = torch.randn(2000, 3)
        # Off by 20, that is by 40 and by 20 / 3 standard deviations of the prior.
        theta = law(x).mean + 20 * torch.randn(2000, 2)
        before = law(x).stddev
        estimator.set_floor(theta, x)
        expected = (before.square() + 2.0**2).sqrt()
        mean, log_std = estimator._moments(x)
        assert torch.allclose(mean, law(x).mean)
        assert torch.allclose(log_std.exp(), expected, rtol=0.05)

    def test_far_from_everything_it_stays_within_bounds(self) -> None:
        estimator, _ = self.estimator()
        estimator.set_floor(torch.randn(100, 2), torch.randn(100, 3))
        x = 1e6 * torch.randn(50, 3)
        theta = torch.tensor([1.0, -2.0])
        log_prob = estimator.log_prob(theta.expand(1, 50, 2), x)
        assert (log_prob > -1e4).all()


class TestCalibrationMLP:
    def trained(self, prior: Any, density_estimator: Any = None) -> Any:
        density_estimator = (
            builder() if density_estimator is None else density_estimator
        )
        method = CalibrationMLP(prior, density_estimator, training=SHORT)
        theta = prior.sample((20,))
        method.append_calibration(theta, torch.cat([theta, theta], 1)[:, :2])
        return method.train(**QUIET).build_posterior().posterior_estimator

    def test_its_network_is_that_of_the_estimator_with_linear_outputs(self) -> None:
        net = nn.Sequential(nn.Linear(2, 7), nn.Tanh())
        estimator = self.trained(TASK.get_prior(), builder(net))
        shapes = [tuple(p.shape) for p in estimator.parameters()]
        assert shapes == [(7, 2), (7,), (4, 7), (4,)]

    def test_parameters_are_standardised_by_the_prior(self) -> None:
        prior = BoxUniform(torch.tensor([10.0, 0.0]), torch.tensor([20.0, 1e-3]))
        estimator = self.trained(prior)
        assert torch.allclose(estimator.mean, torch.tensor([15.0, 5e-4]))
        widths = torch.tensor([10.0, 1e-3])
        assert torch.allclose(estimator.std, widths / 12**0.5)


class TestJointNPE:
    def method(self, n_cal: int, **options: Any) -> JointNPE:
        training = Training(
            training_batch_size=20, learning_rate=1e-2, max_num_epochs=10, **options
        )
        method = JointNPE(TASK.get_prior(), builder(), training=training)
        method.append_simulations(*simulations(60))
        return method.append_calibration(*real(n_cal))

    def test_it_is_chosen_by_a_part_of_the_calibration_pairs(self) -> None:
        method = self.method(20, validation_fraction=0.2).train(**QUIET)
        theta, x = real(20)
        with seeded(0):
            held_out = torch.randperm(20)[:4]
        scores = log_probs(method.build_posterior(), theta[held_out], x[held_out])
        history = method.history
        assert history.kept_validation_loss == min(history.validation_loss)
        kept = history.kept_validation_loss
        assert -float(scores.mean()) == pytest.approx(kept, rel=1e-5)

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
        method.append_simulations(*simulations(60))
        theta, x = real(20)
        method.append_calibration(theta, x + 1000).train(**QUIET)
        assert set(seen) == {(20, 10)}
        assert len(seen) == 2 * 6
        assert len(pairs) == 18  # two are held out


class TestFinetunedNPE:
    def test_of_several_learning_rates_the_best_is_kept(self) -> None:
        kept = {}
        for rates in [(1e-6,), (1e-2,), (1e-6, 1e-2), (1e-2, 1e-6)]:
            method = FinetunedNPE.from_posterior(
                quick_npe().build_posterior(),
                training=Training(max_num_epochs=10, validation_fraction=0.2),
                learning_rates=rates,
            )
            method.append_calibration(*real(50)).train(**QUIET)
            kept[rates] = method.history.kept_validation_loss
            if 1e-2 in rates:
                assert method.history.learning_rate == 1e-2
        assert kept[1e-2,] < kept[1e-6,]

    @pytest.mark.filterwarnings("ignore:Fine-tuning NPE. the loss is not finite")
    def test_the_start_is_kept_where_tuning_makes_it_worse(self) -> None:
        method = FinetunedNPE.from_posterior(
            quick_npe().build_posterior(), training=LONG, learning_rates=(100.0,)
        )
        theta, x = simulations(2050)
        method.append_calibration(theta[2000:], x[2000:]).train(**QUIET)
        assert method.history.best_epoch == 0
        expected = log_probs(quick_npe().build_posterior(), theta[:9], x[:9])
        posterior = method.build_posterior()
        assert torch.equal(log_probs(posterior, theta[:9], x[:9]), expected)


def source_of_simulations(*, stored: bool) -> dict[str, Any]:
    if stored:
        return {"simulations": simulations()}
    return {"simulator": TASK.get_simulator()}


class TestRoPEsParts:
    """The two ablations are RoPE itself."""

    THETA, X = torch.randn(7, 2), torch.randn(7, 2)

    @pytest.mark.parametrize("stored", [True, False])
    def test_tuning_only_is_ropes_tuned_posterior(self, stored: bool) -> None:
        source = source_of_simulations(stored=stored)
        finetuner = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=10)
        posterior = quick_npe().build_posterior()
        rope = RoPE(posterior, finetuner=finetuner, **source)
        rope.append_calibration(*real()).train(**QUIET)
        method = TuningOnly.from_posterior(
            posterior, finetuner=finetuner, simulator=source.get("simulator")
        )
        if stored:
            method.append_simulations(*simulations())
        method.append_calibration(*real()).train(**QUIET)
        expected = log_probs(rope.tuned_posterior(), self.THETA, self.X)
        scored = log_probs(method.build_posterior(), self.THETA, self.X)
        assert torch.equal(scored, expected)
        assert method.history == rope.history

    @pytest.mark.parametrize("stored", [True, False])
    def test_ot_only_is_rope_without_calibration(self, stored: bool) -> None:
        source = source_of_simulations(stored=stored)
        coupler = SinkhornCoupler(gamma=0.8, tau=0.9)
        posterior, (_, x_o) = quick_npe().build_posterior(), TASK.get_test_set(30)
        expected = RoPE(posterior, coupler=coupler, **source).build_posterior(
            x_o, num_simulations=50, seed=0
        )
        method = OTOnly.from_posterior(
            posterior,
            coupler=coupler,
            num_simulations=50,
            simulator=source.get("simulator"),
        )
        if stored:
            method.append_simulations(*simulations())
        mixture = method.append_observations(x_o).train(**QUIET).build_posterior()
        assert torch.equal(mixture.weights, expected.weights)
        assert torch.equal(
            mixture.log_prob_batched(self.THETA[None], x_o[:7]),
            expected.log_prob_batched(self.THETA[None], x_o[:7]),
        )

    def test_ot_only_gives_the_rope_that_couples_if_there_is_something_to_couple_with(
        self,
    ) -> None:
        method = OTOnly.from_posterior(quick_npe().build_posterior())
        with pytest.raises(NotReadyError, match=r"append_simulations\(theta, x\)"):
            method.build_rope()


class TestSBI:
    def method(self) -> ReferenceNPE:
        return ReferenceNPE(TASK.get_prior(), builder()).append_simulations(
            *simulations()
        )

    def test_each_test_parameter_has_a_simulation_of_its_own(self) -> None:
        theta = TASK.get_test_set(2000)[0]
        simulator = TASK.get_simulator()
        kept, x = self.method().simulated_test_set(theta, simulator)
        assert torch.equal(kept, theta)
        noise = x - theta @ simulator.matrix(theta).T
        assert float(noise.mean()) == pytest.approx(0, abs=0.05)
        assert float(noise.std()) == pytest.approx(TASK.noise_std, rel=0.05)


class TestBase:
    def test_npe_given_beforehand_comes_back_as_it_was(self) -> None:
        posterior = gaussian.posterior()
        method = PlainNPE.from_posterior(posterior).train(**QUIET)
        theta, x = gaussian.labelled(6)
        scored = log_probs(method.build_posterior(), theta, x)
        assert torch.equal(scored, log_probs(posterior, theta, x))

    @pytest.mark.parametrize("family", ["fmpe", "npse"])
    def test_npe_given_beforehand_may_be_a_vector_field(self, family: str) -> None:
        posterior = problems.vector_field_posterior(family)
        method = PlainNPE.from_posterior(posterior).train(**QUIET)
        built = method.build_posterior()
        assert type(built) is type(posterior)
        assert built is not posterior
