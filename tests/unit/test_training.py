"""The shared loop keeps the best network; sbi's trainers are used without a trace."""

import copy
import dataclasses
import inspect
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope._groups import MIN_PAIRS_FOR_HOLDOUT, split_pairs
from sbi_rope._sbi.trainer import SimulationTrainer
from sbi_rope._training import (
    EPOCHS_WITHOUT_HOLDOUT,
    History,
    differentiable,
    fit,
)
from sbi_rope.baselines import Training
from sbi_rope.errors import InvalidInputError, RoPEWarning
from sbi_rope.trainers.training import (
    MIN_SIMULATIONS,
    estimator_builder,
    train_on_pairs,
    train_on_simulations,
)
from tests.problems import box, simulate

pytestmark = [
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:.*mixed neural density estimator"),
    pytest.mark.filterwarnings("ignore:Inferring num_categories"),
]


class Number(nn.Module):
    """A number to be trained, from 0 on."""

    def __init__(self) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.zeros(()))


def no_data(step: int) -> Iterator[tuple[()]]:
    yield ()


def run(
    module: nn.Module,
    loss: Callable[..., Tensor],
    validation_loss: Callable[[], Tensor] | None,
    *,
    batches: Callable[[int], Any] = no_data,
    **options: Any,
) -> History:
    settings: dict[str, Any] = {
        "learning_rate": 0.1,
        "max_num_epochs": 30,
        "stop_after_epochs": 100,
        "label": "Numbers",
        "show_progress_bars": False,
    }
    settings.update(options)
    return fit(module, batches, loss, validation_loss=validation_loss, **settings)


def towards(module: Number, target: float) -> Callable[[], Tensor]:
    return lambda: (module.value - target).square()


class TestFit:
    def test_the_best_on_the_held_out_data_is_kept_and_not_the_last(self) -> None:
        module = Number()
        history = run(module, towards(module, 2.0), towards(module, 1.0))
        assert len(history.training_loss) == len(history.validation_loss) == 31
        best = history.best_epoch
        assert 0 < best < 30
        assert history.validation_loss[best] == min(history.validation_loss)
        assert module.value.item() == pytest.approx(1.0, abs=0.06)
        assert history.kept_validation_loss == history.validation_loss[best]
        assert towards(module, 1.0)().item() == history.kept_validation_loss

    def test_any_number_improves_on_a_start_that_is_nan(self) -> None:
        module = Number()

        def validation_loss() -> Tensor:
            distance = (module.value - 3).square()
            return distance if module.value > 0 else distance * torch.nan

        history = run(module, towards(module, 3.0), validation_loss)
        assert math.isnan(history.validation_loss[0])
        assert history.best_epoch > 0
        assert history.kept_validation_loss < 9.0
        lost = History([1.0], [math.nan], 0, 0.1)
        assert lost.kept_validation_loss == math.inf

    def test_the_start_competes(self) -> None:
        module = Number()
        history = run(module, towards(module, 2.0), towards(module, 0.0))
        assert history.best_epoch == 0
        assert module.value.item() == 0.0

    def test_ties_are_won_by_the_earlier(self) -> None:
        module = Number()
        constant = torch.ones(())
        history = run(module, towards(module, 2.0), lambda: constant)
        assert history.best_epoch == 0

    def test_it_stops_when_its_patience_is_at_an_end(self) -> None:
        module = Number()
        history = run(
            module, towards(module, 2), towards(module, 0.5), stop_after_epochs=4
        )
        assert len(history.validation_loss) == history.best_epoch + 1 + 4
        assert len(history.training_loss) == history.best_epoch + 1 + 4

    def test_without_held_out_data_the_last_is_kept(self) -> None:
        module = Number()
        history = run(
            module, towards(module, 10), None, max_num_epochs=7, stop_after_epochs=2
        )
        assert history.best_epoch == 7
        assert history.validation_loss == []
        assert module.value.item() == pytest.approx(0.7, rel=1e-2)
        assert history.kept_validation_loss == 0.0

    @pytest.mark.parametrize("held_out", [True, False])
    def test_of_a_loss_that_ends_in_nan_the_best_before_is_kept(
        self, held_out: bool
    ) -> None:
        """log(1 - w) at w = 0, 0.3, 0.6, 0.9 and then 1.2, about."""
        module = Number()
        with pytest.warns(RoPEWarning, match="Numbers: .* not finite after 4 epochs"):
            history = run(
                module,
                lambda: torch.log(1 - module.value),
                (lambda: -module.value) if held_out else None,
                learning_rate=0.3,
            )
        assert history.best_epoch == 3
        assert module.value.item() == pytest.approx(0.9, abs=0.1)
        assert not math.isfinite(history.training_loss[-1])

    def test_a_pass_with_a_batch_without_a_finite_loss_is_undone(self) -> None:
        module = Number()

        def batches(step: int) -> Iterator[tuple[float]]:
            yield from [(1.0,), (torch.inf,), (1.0,)] if step == 0 else [(1.0,)]

        with pytest.warns(RoPEWarning, match="not finite after 0 epochs"):
            run(
                module,
                lambda factor: factor * (module.value - 2).square(),
                towards(module, 2),
                batches=batches,
            )
        assert module.value.item() == 0.0

    @pytest.mark.parametrize("clip_max_norm", [None, 0.5])
    def test_the_steps_are_those_of_adam_with_clipped_gradients(
        self, clip_max_norm: float | None
    ) -> None:
        """Adam remembers a gradient of 100 for long unless it is clipped."""
        slopes = [100.0, 0.3, 0.2, 0.1]
        module, twin = Number(), Number()
        run(
            module,
            lambda slope: slope * module.value,
            None,
            batches=lambda step: [(slope,) for slope in slopes],
            clip_max_norm=clip_max_norm,
            max_num_epochs=1,
        )
        optimizer = torch.optim.Adam(twin.parameters(), lr=0.1)
        for slope in slopes:
            bound = math.inf if clip_max_norm is None else clip_max_norm
            twin.value.grad = torch.tensor(min(slope, bound))
            optimizer.step()
        assert module.value.item() == pytest.approx(twin.value.item(), rel=1e-5)

    @pytest.mark.parametrize("in_training_mode", [True, False])
    def test_the_mode_is_the_one_asked_for_while_it_trains(
        self, in_training_mode: bool
    ) -> None:
        module = Number().train()
        training, validation = [], []

        def loss() -> Tensor:
            training.append((module.training, torch.is_grad_enabled()))
            return module.value.square()

        def validation_loss() -> Tensor:
            validation.append((module.training, torch.is_grad_enabled()))
            return module.value.square()

        run(
            module,
            loss,
            validation_loss,
            max_num_epochs=2,
            in_training_mode=in_training_mode,
        )
        # The last pass only evaluates.
        assert training == [(in_training_mode, True)] * 2 + [(False, False)]
        assert set(validation) == {(False, False)}
        assert not module.training

    def test_the_training_loss_is_the_mean_over_the_batches(self) -> None:
        module = Number()
        history = run(
            module,
            lambda number: number + 0 * module.value,
            None,
            batches=lambda step: [(float(step),), (step + 3.0,)],
            max_num_epochs=2,
        )
        assert history.training_loss == [1.5, 2.5, 3.5]

    def test_buffers_are_kept_with_the_best(self) -> None:
        module = nn.BatchNorm1d(1, affine=True)
        values = iter([3.0, 1.0, 2.0, 2.0])

        def batches(step: int) -> list[tuple[Tensor]]:
            return [(torch.full((4, 1), 10.0 * (step + 1)),)]

        run(
            module,
            lambda x: module(x).mean(),
            lambda: torch.tensor(next(values)),
            batches=batches,
            max_num_epochs=3,
        )
        # Kept after one step: a tenth of the way from 0 to 10.
        assert module.running_mean is not None
        assert float(module.running_mean) == pytest.approx(1.0)

    @pytest.mark.parametrize("show", [True, False])
    def test_the_progress_is_shown_if_asked_for(
        self, show: bool, terminal: pytest.CaptureFixture[str]
    ) -> None:
        module = Number()
        run(module, towards(module, 1), None, show_progress_bars=show)
        printed = terminal.readouterr()
        assert ("Numbers" in printed.err) is show
        assert ("best" in printed.err) is show
        assert printed.out == ""


class TestTraining:
    def test_values_outside_their_range_are_refused(self) -> None:
        for field, value in [
            ("training_batch_size", 0),
            ("training_batch_size", 1.5),
            ("learning_rate", 0.0),
            ("learning_rate", math.inf),
            ("validation_fraction", 0.0),
            ("validation_fraction", 1.0),
            ("stop_after_epochs", 0),
            ("max_num_epochs", 0),
            ("clip_max_norm", 0.0),
            ("clip_max_norm", "5"),
        ]:
            with pytest.raises(InvalidInputError, match=f"`{field}`"):
                Training(**{field: value})

    def test_the_ends_of_the_ranges_are_taken(self) -> None:
        training = Training(
            training_batch_size=1, validation_fraction=0.5, clip_max_norm=None
        )
        assert training.clip_max_norm is None

    def test_its_fields_are_arguments_of_sbis_train(self) -> None:
        known = inspect.signature(NPE.train).parameters
        for field in dataclasses.fields(Training):
            assert known[field.name].default == field.default


def small(net: nn.Module | None = None) -> Any:
    net = nn.Identity() if net is None else net
    return posterior_nn("mdn", embedding_net=net, hidden_features=8, num_components=2)


class TestEstimatorBuilder:
    def test_each_estimator_has_a_copy_of_the_net(self) -> None:
        net = nn.Linear(3, 2)
        build = estimator_builder(small(net))
        theta, x = torch.randn(20, 2), torch.randn(20, 3)
        first, second = build(theta, x), build(theta, x)
        own = {id(p) for p in net.parameters()}
        for estimator, other in [(first, second), (second, first)]:
            ids = {id(p) for p in estimator.parameters()}
            assert not ids & own
            assert not ids & {id(p) for p in other.parameters()}

    def test_trying_the_net_on_one_observation_leaves_it_as_it_was(self) -> None:
        """Also a net in training mode, where sbi's trial moves batch statistics."""
        norm = nn.BatchNorm1d(2)
        net = nn.Sequential(nn.Unflatten(1, (2, 4)), norm, nn.Flatten())
        before = copy.deepcopy(norm.state_dict())
        estimator_builder(small(net))(torch.randn(20, 2), torch.randn(20, 8))
        after = norm.state_dict()
        assert all(torch.equal(before[key], after[key]) for key in before)
        assert norm.training

    def test_a_name_is_that_of_sbi(self) -> None:
        for name in ["mdn", "maf", "nsf"]:
            theta, x = torch.randn(20, 2), torch.randn(20, 3)
            torch.manual_seed(1)
            ours = estimator_builder(name)(theta, x)
            torch.manual_seed(1)
            theirs = posterior_nn(name)(theta, x)
            assert type(ours) is type(theirs)
            state = theirs.state_dict()
            assert all(torch.equal(v, state[k]) for k, v in ours.state_dict().items())

    def test_checking_a_name_leaves_no_trace(self) -> None:
        before = torch.get_rng_state()
        estimator_builder("maf")
        assert torch.equal(torch.get_rng_state(), before)

    def test_an_unknown_name_is_refused(self) -> None:
        for name in ["", "fancy", "MAF", "mnpe"]:
            with pytest.raises(
                InvalidInputError, match=f"`density_estimator`.*{name!r}"
            ):
                estimator_builder(name)

    def test_what_cannot_build_is_refused(self) -> None:
        for value in [None, 3, ("maf",)]:
            with pytest.raises(InvalidInputError, match="`density_estimator`"):
                estimator_builder(value)


def pairs(n: int) -> tuple[Tensor, Tensor]:
    theta = box(2).sample((n,))
    return theta, simulate(theta)


def with_sbi(n: int = 60, **options: Any) -> tuple[Any, History]:
    settings: dict[str, Any] = {"max_num_epochs": 5, "training_batch_size": 20}
    settings.update(options)
    return train_on_simulations(
        box(2),
        estimator_builder(small()),
        *pairs(n),
        training=Training(**settings),
        show_progress_bars=False,
    )


class TestTrainWithSBI:
    def test_it_prints_nothing_and_writes_nothing(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        with_sbi()
        with_sbi(stop_after_epochs=1, max_num_epochs=100, learning_rate=0.1)
        assert os.listdir(tmp_path) == []
        printed = capsys.readouterr()
        assert printed.out == printed.err == ""

    def test_the_history_is_that_of_the_epochs(self) -> None:
        estimator, history = with_sbi(learning_rate=0.05, max_num_epochs=40)
        assert len(history.training_loss) == len(history.validation_loss)
        assert history.kept_validation_loss == min(history.validation_loss)
        assert history.validation_loss[history.best_epoch] < history.validation_loss[0]
        assert history.learning_rate == 0.05
        assert not estimator.training

    def test_the_options_reach_sbi(self) -> None:
        _, history = with_sbi(max_num_epochs=3)
        assert len(history.training_loss) == 3
        _, stopped = with_sbi(
            stop_after_epochs=1, max_num_epochs=200, learning_rate=0.3
        )
        assert len(stopped.training_loss) < 100

    def test_too_few_simulations_are_refused(self) -> None:
        with_sbi(MIN_SIMULATIONS, max_num_epochs=1)
        with pytest.raises(InvalidInputError, match=f"at least {MIN_SIMULATIONS}"):
            with_sbi(MIN_SIMULATIONS - 1)


def split_of(make_trainer: Any, theta: Tensor) -> tuple[Tensor, Tensor]:
    trainer = make_trainer(prior=box(2), show_progress_bars=False)
    trainer.append_simulations(theta, simulate(theta))
    torch.manual_seed(0)
    trainer.get_dataloaders(training_batch_size=10, validation_fraction=0.2)
    return trainer.train_indices, trainer.val_indices


class TestSimulationTrainer:
    def test_recordings_of_a_person_are_held_out_together(self) -> None:
        people = box(2).sample((12,))
        theta = people.repeat(6, 1)
        train, held_out = split_of(SimulationTrainer, theta)
        assert sorted(torch.cat([train, held_out]).tolist()) == list(range(72))
        assert not set(train.remainder(12).tolist()) & set(
            held_out.remainder(12).tolist()
        )
        assert 72 * 0.2 <= len(held_out) < 72 * 0.2 + 6

    def test_without_recordings_of_the_same_it_is_the_split_of_sbi(self) -> None:
        theta = box(2).sample((50,))
        for ours, sbis in zip(
            split_of(SimulationTrainer, theta), split_of(NPE, theta), strict=True
        ):
            assert torch.equal(ours, sbis)

    def test_a_few_people_are_held_out_together_in_smaller_batches(self) -> None:
        """Fewer than a batch of 20 are left to train on, or hardly any held out."""
        for sizes in [(1, 19), (6, 7, 12), (2, 2, 30)]:
            people = box(2).sample((len(sizes),))
            theta = people.repeat_interleave(torch.tensor(sizes), dim=0)
            for seed in range(6):
                torch.manual_seed(seed)
                trainer = SimulationTrainer(prior=box(2), show_progress_bars=False)
                trainer.append_simulations(theta, simulate(theta))
                loaders = trainer.get_dataloaders(0, 20, 0.3)
                rows = trainer.train_indices, trainer.val_indices
                assert sorted(torch.cat(rows).tolist()) == list(range(len(theta)))
                train, held_out = (set(map(tuple, theta[r].tolist())) for r in rows)
                assert train
                assert held_out
                assert not train & held_out
                assert len(rows[0]) >= len(rows[1])
                for loader in loaders:
                    assert sum(len(batch[0]) for batch in loader) > 0

    def test_a_single_person_is_split_by_recording(self) -> None:
        theta = box(2).sample((1,)).repeat(30, 1)
        train, held_out = split_of(SimulationTrainer, theta)
        assert (len(train), len(held_out)) == (24, 6)


def on_pairs(n: int, **options: Any) -> tuple[Any, Any, History]:
    theta, x = pairs(n)
    estimator = small()(theta, x)
    before = copy.deepcopy(estimator)
    history = train_on_pairs(
        estimator,
        theta,
        x,
        split_pairs(torch.arange(n), 0.2),
        training=Training(training_batch_size=8, **options),
        in_training_mode=True,
        label="Pairs",
        show_progress_bars=False,
    )
    return before, estimator, history


class TestTrainOnPairs:
    def test_the_hold_out_is_never_worse_than_before(self) -> None:
        before, estimator, history = on_pairs(30, learning_rate=0.3, max_num_epochs=30)
        assert history.kept_validation_loss <= history.validation_loss[0]
        assert not estimator.training
        assert before.training

    def test_without_a_hold_out_it_stops_early_and_warns(self) -> None:
        few = MIN_PAIRS_FOR_HOLDOUT - 1
        with pytest.warns(RoPEWarning, match=f"Only {few} calibration pair"):
            _, _, history = on_pairs(few)
        assert history.best_epoch == EPOCHS_WITHOUT_HOLDOUT

    def test_fewer_epochs_than_that_can_be_asked_for(self) -> None:
        with pytest.warns(RoPEWarning):
            _, _, history = on_pairs(2, max_num_epochs=3)
        assert history.best_epoch == 3

    def test_the_validation_loss_is_the_mean_over_the_held_out_rows(self) -> None:
        theta, x = pairs(20)
        estimator = small()(theta, x).eval()
        split = split_pairs(torch.arange(20), 0.2)
        expected = estimator.loss(theta[split[1]], condition=x[split[1]]).mean()
        history = train_on_pairs(
            estimator,
            theta,
            x,
            split,
            training=Training(max_num_epochs=1),
            in_training_mode=True,
            label="Pairs",
            show_progress_bars=False,
        )
        assert history.validation_loss[0] == pytest.approx(expected.item(), rel=1e-5)


def test_recurrent_nets_in_evaluation_mode_do_not_use_cudnn() -> None:
    # cuDNN has no gradients for them. On a CPU only the flag can be seen.
    before = torch.backends.cudnn.enabled
    recurrent = nn.Sequential(nn.GRU(1, 2))
    for net, is_off in (
        (recurrent.eval(), True),
        (nn.Sequential(nn.GRU(1, 2)).train(), False),
        (nn.Linear(1, 2).eval(), False),
    ):
        with differentiable(net):
            assert torch.backends.cudnn.enabled == (before and not is_off)
        assert torch.backends.cudnn.enabled == before
