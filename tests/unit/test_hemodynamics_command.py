"""The command that generates, validates and describes pressure waves."""

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sbi_rope.errors import SimulationError
from sbi_rope.tasks.hemodynamics import generation, waveforms
from sbi_rope.tasks.hemodynamics.__main__ import main
from sbi_rope.tasks.hemodynamics.dataset import load
from sbi_rope.tasks.hemodynamics.population import Population
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject

PNG = b"\x89PNG"
PHASE = 2 * np.pi * np.arange(256) / 256


def hum(subject: Subject, physics: Physics) -> Beat:
    """Stand in for the solver."""
    if subject.age > 70.0:
        raise SimulationError(f"Unstable at {subject.age:g} years.")
    wave = subject.mean_pressure + 20.0 * np.cos(PHASE)
    return Beat(
        period=subject.period,
        pressure=dict.fromkeys(("radial", "brachial", "aortic"), wave),
        period_error=0.01,
        mass_error=1e-5,
        courant=0.4 if subject.age < 30.0 else physics.courant,
    )


@pytest.fixture(autouse=True)
def _no_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "_default_simulate", lambda: hum)
    monkeypatch.setattr(waveforms, "simulate_beat", hum)  # for the picture


def _generate(file: Path, *options: str) -> int:
    process = () if "--process" in options else ("--process", "real")
    return main(["generate", "--n", "50", *process, *options, "--out", str(file)])


def test_generate_writes_the_file_and_counts_the_rejected(
    tmp_path: Path, terminal: pytest.CaptureFixture[str]
) -> None:
    assert _generate(tmp_path / "x.npz", "--seed", "3") == 0
    captured = terminal.readouterr()
    beats = load(tmp_path / "x.npz", process="real")
    assert (len(beats), beats.settings["seed"]) == (50, 3)
    rejected = sum(beats.rejected.values())
    assert rejected > 0
    assert f"50 people, {rejected} rejected" in captured.out
    assert f"{rejected}: Unstable at # years" in captured.out
    assert "50/50" in captured.err  # of the progress bar


def test_options_of_generate_reach_population_and_physics(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "x.npz"
    options = "--prior independent --height-sd 0.05 --segment-sd 0.2 --fixed-aorta"
    physics = "--cell-length 0.02 --num-cycles 8 --elastic"
    assert _generate(path, *options.split(), *physics.split()) == 0
    settings = load(path).settings
    assert settings["population"] == asdict(
        Population(
            prior="independent", height_sd=0.05, segment_sd=0.2, proximal_aorta=False
        )
    )
    assert settings["physics"] == asdict(
        Physics(cell_length=0.02, num_cycles=8, viscoelastic=False)
    )


def test_errors_of_generate_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, word in (
        (["--n", "0"], "`n`"),
        (["--height-sd", "-1"], "height_sd"),
    ):
        assert _generate(tmp_path / "x.npz", *options) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert word in lines[0]
    assert not list(tmp_path.iterdir())


def test_info_summarises_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "x.npz"
    _generate(file)
    capsys.readouterr()
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    rows = {line[:32].strip(): line[32:].split() for line in out.splitlines()}
    beats = load(file)
    systolic = beats.beat.amax(dim=1)
    assert float(rows["systolic pressure [mmHg]"][0]) == pytest.approx(
        float(systolic.mean()), rel=1e-3
    )
    assert float(rows["pulse pressure [mmHg]"][0]) == pytest.approx(40.0, abs=0.1)
    assert "process: real" in out
    young = int((beats.nuisance[:, 0] < 30.0).sum())
    assert f"smaller time step: {young}\n" in out


def _table(passed: bool | None) -> Any:
    measured: Any = SimpleNamespace(name="mass", measured=2e-5, goal="< 1e-4")
    open_row: Any = SimpleNamespace(name="cca", measured=None, goal="< 1")
    measured.unit, measured.passed = "1", True
    open_row.unit, open_row.passed = "%", passed
    rows = [measured, open_row]
    return lambda reference: rows


def test_validate_prints_the_table_and_tells_whether_a_row_failed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    validation = pytest.importorskip("sbi_rope.tasks.hemodynamics.validation")
    for passed, status in ((True, 0), (None, 0), (False, 1)):
        monkeypatch.setattr(validation, "validation_table", _table(passed))
        assert main(["validate"]) == status
        lines = capsys.readouterr().out.splitlines()
        assert lines[1].split() == ["mass", "2e-05", "<", "1e-4", "1", "yes"]
        assert lines[2].split()[:3] == ["cca", "not", "run"]


@pytest.mark.medium
def test_validate_draws_beats_of_both_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    validation = pytest.importorskip("sbi_rope.tasks.hemodynamics.validation")
    monkeypatch.setattr(validation, "validation_table", _table(passed=True))
    monkeypatch.setattr(Population, "draw", _anyone(Population.draw))
    picture = tmp_path / "folder" / "waves.png"
    assert main(["validate", "--plot", str(picture)]) == 0
    assert picture.read_bytes().startswith(PNG)


def _anyone(draw: Any) -> Any:
    """Return a draw of people whom the stand-in accepts."""

    def young(self: Population, process: Any, seed: int, index: int) -> Subject:
        subjects = (draw(self, process, seed, index + 1000 * i) for i in range(100))
        return next(subject for subject in subjects if subject.age <= 70.0)

    return young
