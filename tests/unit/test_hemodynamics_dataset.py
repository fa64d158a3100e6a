"""Stored beats: made in parallel, and read."""

import importlib
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch

from sbi_rope.tasks.hemodynamics import generation
from sbi_rope.tasks.hemodynamics.__main__ import main
from sbi_rope.tasks.hemodynamics.dataset import BeatSet, load
from sbi_rope.tasks.hemodynamics.generation import generate
from sbi_rope.tasks.hemodynamics.population import NUISANCES, Population
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject
from sbi_rope.utils.errors import InvalidInputError, SimulationError
from tests.fresh import imported_anew

N = 65


def hum(subject: Subject, physics: Physics) -> Beat:
    """Stand in for the solver: a cosine that knows who it belongs to."""
    if subject.age > 70.0:
        raise SimulationError(f"The flow broke down after {subject.age:g} years. Rest.")
    phase = 2 * np.pi * np.arange(256) / 256
    wave = subject.mean_pressure + subject.stroke_volume * np.cos(phase)
    return Beat(
        period=subject.period,
        pressure={"radial": wave},
        period_error=0.01,
        mass_error=physics.cell_length,
        courant=0.6,
    )


def _make(path: Path, **changes: Any) -> BeatSet:
    settings: dict[str, Any] = {"n": N, "process": "real", "seed": 4, "jobs": 1}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "simulate_beat", hum)
        return generate(path, **(settings | {"progress": False} | changes))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("beats") / "real.npz"
    _make(path)
    return path


# What is stored ----------------------------------------------------------------------


def test_rows_belong_to_the_people_of_the_cohort(made: Path) -> None:
    beats = load(made)
    assert len(beats) == N
    for row in (0, 17, N - 1):
        subject = Population().draw("real", seed=4, index=int(beats.index[row]))
        wave = hum(subject, Physics()).pressure["radial"]
        np.testing.assert_allclose(beats.beat[row], wave, rtol=1e-6)
        theta = [subject.stroke_volume, subject.ejection_time]
        np.testing.assert_allclose(beats.theta[row], theta, rtol=1e-6)
        nuisance = [getattr(subject, name) for name in NUISANCES]
        np.testing.assert_allclose(beats.nuisance[row], nuisance, rtol=1e-6)
        assert beats.length_factors is not None
        lengths = beats.length_factors[row]
        np.testing.assert_allclose(lengths, subject.length_factors, rtol=1e-6)
        assert float(beats.period[row]) == pytest.approx(subject.period)
    assert beats.beat.dtype == beats.theta.dtype == torch.float32


def test_people_who_cannot_be_simulated_are_counted_and_replaced_by_the_next(
    made: Path,
) -> None:
    beats = load(made)
    ages = []
    while sum(age <= 70.0 for age in ages) < N:
        ages.append(Population().draw("real", seed=4, index=len(ages)).age)
    accepted = [index for index, age in enumerate(ages) if age <= 70.0]
    assert beats.index.tolist() == accepted
    reason = "The flow broke down after # years"
    assert beats.rejected == {reason: len(ages) - N}
    assert len(ages) > N


def test_a_file_has_the_same_bytes_for_any_number_of_jobs(
    made: Path, tmp_path: Path
) -> None:
    with joblib.parallel_config(backend="threading"):
        _make(tmp_path / "again.npz", jobs=2)
    assert (tmp_path / "again.npz").read_bytes() == made.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.npz"]


def test_a_finished_file_is_never_overwritten(made: Path) -> None:
    content = made.read_bytes()
    with pytest.raises(InvalidInputError, match="Expected no file"):
        _make(made)
    assert made.read_bytes() == content


def test_the_command_writes_the_file_and_counts_the_rejected(
    tmp_path: Path,
    terminal: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(generation, "simulate_beat", hum)
    out = tmp_path / "x.npz"
    options = f"generate --n 50 --process real --seed 3 --out {out}"
    assert main(options.split()) == 0
    captured = terminal.readouterr()
    beats = load(out, process="real")
    assert (len(beats), beats.settings["seed"]) == (50, 3)
    rejected = sum(beats.rejected.values())
    assert f"50 people, {rejected} rejected" in captured.out
    assert f"{rejected}: The flow broke down after # years" in captured.out
    assert "50/50" in captured.err  # of the progress bar


@pytest.mark.medium
def test_stored_beats_load_without_numba(made: Path) -> None:
    with imported_anew(without=("numba",)):
        dataset = importlib.import_module("sbi_rope.tasks.hemodynamics.dataset")
        command = importlib.import_module("sbi_rope.tasks.hemodynamics.__main__")
        assert dataset.load is not load
        assert len(dataset.load(made)) == N
        assert command.main(["info", str(made)]) == 0
