"""Stored beats: made in parallel, resumed after an interrupt, and read."""

import importlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch

from sbi_rope._files import read_arrays
from sbi_rope.errors import DataNotFoundError, InvalidInputError, SimulationError
from sbi_rope.tasks.hemodynamics.dataset import BeatSet, load
from sbi_rope.tasks.hemodynamics.generation import CHUNK_SIZE, generate
from sbi_rope.tasks.hemodynamics.population import NUISANCES, Population
from sbi_rope.tasks.hemodynamics.store import write_arrays
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
    assert settings["population"] == Population().as_dict()
    assert settings["physics"] == Physics().as_dict()


def test_files_of_the_simulator_hold_no_lengths_of_arteries(tmp_path: Path) -> None:
    narrow = _make(tmp_path / "a.npz", n=3, process="simulator")
    assert narrow.length_factors is None
    wide = Population(segment_sd=0.4)
    _make(tmp_path / "b.npz", n=3, process="simulator", population=wide)
    same = (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert same  # lengths vary in the real process only
    load(tmp_path / "a.npz", population=wide)


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


@pytest.mark.medium
def test_a_file_has_the_same_bytes_from_a_backend_without_generators(
    made: Path, tmp_path: Path
) -> None:
    with joblib.parallel_config(backend="multiprocessing"):
        _make(tmp_path / "again.npz", jobs=2)
    assert (tmp_path / "again.npz").read_bytes() == made.read_bytes()


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
    for changes, words in (
        ({"seed": 5}, "seed is 4 instead of 5"),
        ({"n": N + 1}, f"n is {N} instead of {N + 1}"),
        ({"process": "simulator"}, "process is 'real' instead of 'simulator'"),
        ({"population": Population(segment_sd=0.2)}, "segment_sd is 0.15 instead"),
        ({"physics": Physics(cell_length=0.02)}, "cell_length is 0.01 instead of 0.02"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            _make(path, **changes)
    _make(path)


def test_files_of_others_in_the_working_folder_are_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "again.npz.parts"
    folder.mkdir()
    (folder / "settings.json").write_text("[1]")
    with pytest.raises(InvalidInputError, match="to hold settings"):
        _make(tmp_path / "again.npz")
    (folder / "settings.json").unlink()
    (folder / "notes.txt").write_text("mine")
    _make(tmp_path / "again.npz", n=3)
    assert (folder / "notes.txt").read_text() == "mine"


# Bad input ---------------------------------------------------------------------------


def test_a_finished_file_is_never_overwritten(file: Path) -> None:
    content = file.read_bytes()
    with pytest.raises(InvalidInputError, match="Expected no file"):
        _make(file)
    assert file.read_bytes() == content
    assert not file.with_name("copy.npz.parts").exists()


def test_generate_refuses_bad_arguments(tmp_path: Path) -> None:
    for changes in ({"n": 0}, {"seed": -1}, {"process": "other"}, {"jobs": 0}):
        with pytest.raises(InvalidInputError, match=next(iter(changes))):
            _make(tmp_path / "again.npz", **changes)
    assert not list(tmp_path.iterdir())


def test_generating_stops_where_nobody_can_be_simulated(tmp_path: Path) -> None:
    def fail(subject: Subject, physics: Physics) -> Beat:
        raise SimulationError("The flow stopped at 3.5 s; 2 mmHg left.")

    with pytest.raises(SimulationError, match="The flow stopped at # s"):
        _make(tmp_path / "again.npz", simulate=fail, n=30)


def test_a_missing_file_is_named_with_the_command_that_makes_it(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"none\.npz.*generate"):
        load(tmp_path / "none.npz")


def _truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[2000] ^= 0xFF
    file.write_bytes(content)


def _text(file: Path) -> None:
    file.write_text("subject,pressure\n1,120\n")


def _empty(file: Path) -> None:
    file.write_bytes(b"")


def _array(file: Path) -> None:
    with file.open("wb") as stream:
        np.save(stream, np.ones(3))


def _foreign(file: Path) -> None:
    with file.open("wb") as stream:
        np.savez(stream, x=np.ones(3))


def _edit(**changes: Any) -> Callable[[Path], None]:
    def edit(file: Path) -> None:
        arrays = read_arrays(file)
        for name, value in changes.items():
            if value is None:
                del arrays[name]
            else:
                arrays[name] = value(arrays[name])
        write_arrays(file, arrays)

    return edit


def _set(**settings: Any) -> Callable[[Path], None]:
    def change(header: np.ndarray) -> np.ndarray:
        content = json.loads(str(header))
        for name, value in settings.items():
            if value is None:
                del content["settings"][name]
            else:
                content["settings"][name] = value
        return np.array(json.dumps(content))

    return _edit(settings=change)


def _with_nan(array: np.ndarray) -> np.ndarray:
    array[3, 5] = np.nan
    return array


DAMAGES: list[tuple[Callable[[Path], None], str]] = [
    (_truncate, "is cut"),
    (_flip, "is cut"),
    (_text, "a file that is none"),
    (_empty, "a file that is none"),
    (_array, "a file that is none"),
    (_foreign, "a file that is none"),
    (_set(format=99), "format 99"),
    (_set(physics=None), r"\['physics'\] are missing"),
    (_set(n=N + 1), "beat"),
    (_set(process="patient"), r"\['process'\] are no such"),
    (_edit(theta=None), "`theta`.* got none"),
    (_edit(length_factors=None), "`length_factors`.* got none"),
    (_edit(beat=_with_nan), "`beat`.* finite"),
    (_edit(period=lambda a: a[:-1]), "`period`.* shape"),
    (_edit(theta=lambda a: a.astype(np.float64)), "`theta`.* float32"),
    (_edit(nuisance_names=lambda a: a[::-1]), "nuisance parameters"),
    (_edit(nuisance_names=None), "nuisance parameters"),
    (_edit(beat=np.ones_like), "not vary .*row 0"),
    (_edit(period=np.zeros_like), "`period` that no heart has"),
    (_edit(index=np.zeros_like), "`index` not above"),
    (_set(population=3), r"\['population'\] are no such"),
    (_set(population={"height_sd": 0.1}), r"\['population'\] are no such"),
    (_set(physics={"courant": 0.1}), r"\['physics'\] are no such"),
]


def test_a_damaged_file_is_refused(made: Path, tmp_path: Path) -> None:
    wrong = []
    for i, (damage, words) in enumerate(DAMAGES):
        file = tmp_path / f"{i}.npz"
        file.write_bytes(made.read_bytes())
        load(file)
        damage(file)
        try:
            load(file)
        except InvalidInputError as error:
            if not re.search(words, str(error)):
                wrong.append(f"{i}: expected {words!r} in {str(error)!r}")
        else:
            wrong.append(f"{i}: {words!r} was accepted")
    assert not wrong


def test_a_file_with_other_settings_than_asked_for_is_refused(made: Path) -> None:
    load(made, process="real", population=Population(), physics=Physics())
    with pytest.raises(InvalidInputError, match="'real' instead of 'simulator'"):
        load(made, process="simulator")
    with pytest.raises(InvalidInputError, match=r"height_sd is 0\.1 instead of 0\.2"):
        load(made, population=Population(height_sd=0.2))
    with pytest.raises(InvalidInputError, match=r"courant is 0\.6 instead of 0\.5"):
        load(made, physics=Physics(courant=0.5))


@pytest.mark.medium
def test_stored_beats_load_without_numba(made: Path) -> None:
    with imported_anew(without=("numba",)):
        dataset = importlib.import_module("sbi_rope.tasks.hemodynamics.dataset")
        command = importlib.import_module("sbi_rope.tasks.hemodynamics.__main__")
        assert dataset.load is not load
        assert len(dataset.load(made)) == N
        assert command.main(["info", str(made)]) == 0
