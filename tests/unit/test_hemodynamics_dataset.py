"""Stored beats: made in parallel, resumed after an interrupt, and read."""

import importlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch

from sbi_rope.errors import DataNotFoundError, InvalidInputError, SimulationError
from sbi_rope.tasks.hemodynamics.dataset import BeatSet, load
from sbi_rope.tasks.hemodynamics.generation import CHUNK_SIZE, generate
from sbi_rope.tasks.hemodynamics.population import NUISANCES, Population
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject
from tests.fresh import imported_anew

N = 3 * CHUNK_SIZE + 5


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


class Interrupted:
    """Stop, as by Ctrl-C, after a number of calls."""

    def __init__(self, calls: int) -> None:
        self.left = calls

    def __call__(self, subject: Subject, physics: Physics) -> Beat:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return hum(subject, physics)


def _make(path: Path, **changes: Any) -> BeatSet:
    settings: dict[str, Any] = {
        "n": N,
        "process": "real",
        "seed": 4,
        "simulate": hum,
        "progress": False,
    }
    return generate(path, **(settings | changes))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("beats") / "real.npz"
    _make(path)
    return path


@pytest.fixture
def file(made: Path, tmp_path: Path) -> Path:
    """Return a copy that may be damaged."""
    path = tmp_path / "copy.npz"
    path.write_bytes(made.read_bytes())
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
    assert beats.nuisance_names == NUISANCES
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


def test_waves_that_are_not_finite_are_rejected(tmp_path: Path) -> None:
    def overflow(subject: Subject, physics: Physics) -> Beat:
        beat = hum(replace(subject, age=50.0), physics)
        wave = np.full(256, np.nan) if subject.age > 60.0 else beat.pressure["radial"]
        return replace(beat, pressure={"radial": wave})

    beats = _make(tmp_path / "again.npz", n=30, simulate=overflow)
    assert set(beats.rejected) == {"The pressures are not finite"}
    assert (beats.nuisance[:, 0] <= 60.0).all()


def test_settings_are_stored(made: Path) -> None:
    settings = load(made).settings
    assert settings["process"] == "real"
    assert (settings["n"], settings["seed"]) == (N, 4)
    assert settings["population"] == asdict(Population())
    assert settings["physics"] == asdict(Physics())


def test_files_of_the_simulator_hold_no_lengths_of_arteries(tmp_path: Path) -> None:
    narrow = _make(tmp_path / "a.npz", n=3, process="simulator")
    assert narrow.length_factors is None
    wide = Population(segment_sd=0.4)
    _make(tmp_path / "b.npz", n=3, process="simulator", population=wide)
    same = (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert same  # lengths vary in the real process only


# The same bytes ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "backend",
    [
        "sequential",
        "threading",
        # Its processes import everything anew. Those of "multiprocessing", below, do
        # not.
        pytest.param("loky", marks=pytest.mark.slow),
    ],
)
def test_a_file_has_the_same_bytes_for_any_number_of_jobs_and_any_backend(
    backend: str, made: Path, tmp_path: Path
) -> None:
    with joblib.parallel_config(backend=backend, n_jobs=2):
        _make(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == made.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.npz"]


def test_an_interrupted_run_goes_on_with_the_same_bytes(
    made: Path, tmp_path: Path
) -> None:
    path = tmp_path / "again.npz"
    done = CHUNK_SIZE + 3
    for _ in range(2):  # interrupted twice
        with pytest.raises(KeyboardInterrupt):
            _make(path, simulate=Interrupted(done))
        assert not path.exists()
    parts = sorted((tmp_path / "again.npz.parts").glob("part_*"))
    assert len(parts) == 2
    rest = Interrupted(N)
    _make(path, simulate=rest)
    assert path.read_bytes() == made.read_bytes()
    accepted = len(load(path)) - rest.left
    assert accepted <= N - 2 * CHUNK_SIZE + sum(load(path).rejected.values())
    assert [path.name for path in tmp_path.iterdir()] == ["again.npz"]


def test_parts_that_are_damaged_or_of_other_people_are_made_again(
    made: Path, tmp_path: Path
) -> None:
    path = tmp_path / "again.npz"
    with pytest.raises(KeyboardInterrupt):
        _make(path, simulate=Interrupted(3 * CHUNK_SIZE))
    parts = sorted((tmp_path / "again.npz.parts").glob("part_*"))
    assert len(parts) == 3
    parts[1].write_bytes(parts[0].read_bytes())
    parts[2].write_bytes(parts[2].read_bytes()[:500])
    _make(path)
    assert path.read_bytes() == made.read_bytes()


def test_unfinished_work_with_other_settings_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "again.npz"
    with pytest.raises(KeyboardInterrupt):
        _make(path, simulate=Interrupted(0))
    for changes in (
        {"seed": 5},
        {"n": N + 1},
        {"process": "simulator"},
        {"population": Population(segment_sd=0.2)},
        {"physics": Physics(cell_length=0.02)},
    ):
        with pytest.raises(InvalidInputError, match="unfinished work"):
            _make(path, **changes)
    _make(path)


# Bad input ---------------------------------------------------------------------------


def test_a_finished_file_is_never_overwritten(file: Path) -> None:
    content = file.read_bytes()
    with pytest.raises(InvalidInputError, match="Expected no file"):
        _make(file)
    assert file.read_bytes() == content
    assert not file.with_name("copy.npz.parts").exists()


def test_generating_stops_where_nobody_can_be_simulated(tmp_path: Path) -> None:
    def fail(subject: Subject, physics: Physics) -> Beat:
        raise SimulationError("The flow stopped at 3.5 s; 2 mmHg left.")

    with pytest.raises(SimulationError, match="The flow stopped at # s"):
        _make(tmp_path / "again.npz", simulate=fail, n=30)


def test_files_that_are_no_data_set_are_refused(file: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"none\.npz.*generate"):
        load(file.with_name("none.npz"))
    with pytest.raises(InvalidInputError, match="of simulator"):
        load(file, process="simulator")
    content = file.read_bytes()
    flipped = bytearray(content)
    flipped[2000] ^= 0xFF
    for damaged in (content[: len(content) // 2], flipped, b"", b"a,b\n1,2\n"):
        file.write_bytes(damaged)
        with pytest.raises(InvalidInputError, match=r"copy\.npz"):
            load(file)
    np.savez(file, x=np.ones(3))
    with pytest.raises(InvalidInputError, match="settings"):
        load(file)


@pytest.mark.medium
def test_stored_beats_load_without_numba(made: Path) -> None:
    with imported_anew(without=("numba",)):
        dataset = importlib.import_module("sbi_rope.tasks.hemodynamics.dataset")
        command = importlib.import_module("sbi_rope.tasks.hemodynamics.__main__")
        assert dataset.load is not load
        assert len(dataset.load(made)) == N
        assert command.main(["info", str(made)]) == 0
