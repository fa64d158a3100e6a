"""sbi's trainers are used without a trace."""

import dataclasses
import inspect
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from sbi.inference import NPE
from torch import Tensor

from sbi_rope.methods import Training
from sbi_rope.methods.training import (
    SimulationTrainer,
    estimator_builder,
    train_on_simulations,
)
from tests.problems import box, simulate

pytestmark = [
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:.*mixed neural density estimator"),
    pytest.mark.filterwarnings("ignore:Inferring num_categories"),
]


def test_the_settings_of_a_training_are_arguments_of_sbis_train() -> None:
    known = inspect.signature(NPE.train).parameters
    for field in dataclasses.fields(Training):
        assert known[field.name].default == field.default


def test_training_leaves_no_trace_and_its_history_is_that_of_the_epochs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    theta = box(2).sample((60,))
    estimator, history = train_on_simulations(
        box(2),
        estimator_builder("mdn"),
        theta,
        simulate(theta),
        training=Training(
            learning_rate=0.05, max_num_epochs=40, training_batch_size=20
        ),
        show_progress_bars=False,
    )
    assert os.listdir(tmp_path) == []
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""
    assert len(history.training_loss) == len(history.validation_loss) <= 40
    assert history.kept_validation_loss == min(history.validation_loss)
    assert history.validation_loss[history.best_epoch] < history.validation_loss[0]
    assert not estimator.training


def split_of(kind: type[NPE], theta: Tensor, fraction: float) -> list[Tensor]:
    """The parameters to train on and those held out, in the batches of a trainer."""
    trainer = kind(prior=box(2), show_progress_bars=False)
    trainer.append_simulations(theta, simulate(theta))
    torch.manual_seed(0)
    loaders = trainer.get_dataloaders(0, 10, fraction)
    return [torch.cat([batch[0] for batch in loader]) for loader in loaders]


def test_without_recordings_of_the_same_it_is_the_split_of_sbi() -> None:
    theta = box(2).sample((50,))
    ours, sbis = (split_of(one, theta, 0.2) for one in (SimulationTrainer, NPE))
    assert all(map(torch.equal, ours, sbis))


@pytest.mark.parametrize("people", [(1, 2, 3, 4, 30), (6,) * 12])
def test_recordings_of_a_person_are_held_out_together(people: Any) -> None:
    theta = box(2).sample((len(people),))
    theta = theta.repeat_interleave(torch.tensor(people), dim=0)
    rows = split_of(SimulationTrainer, theta, 0.3)
    train, held_out = (set(map(tuple, of.tolist())) for of in rows)
    assert not train & held_out
    # None is left out of the hold-out, and less than a batch of the others.
    assert 1 <= len(rows[1]) < len(theta) / 2
    assert 0 <= len(theta) - len(rows[1]) - len(rows[0]) < 10


def test_a_network_is_standardised_by_the_people_it_is_trained_on() -> None:
    seen: list[Tensor] = []

    def build(theta: Tensor, x: Tensor) -> Any:
        seen.append(theta)
        return estimator_builder("mdn")(theta, x)

    theta = box(2).sample((12,)).repeat_interleave(6, dim=0)
    train_on_simulations(
        *(box(2), build, theta, simulate(theta)),
        training=Training(max_num_epochs=1, training_batch_size=20),
        show_progress_bars=False,
    )
    assert len(seen[0].unique(dim=0)) == 11  # a tenth of the people is held out
