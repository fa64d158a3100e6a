"""The command that generates and describes pressure waves."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from sbi_rope.errors import SimulationError
from sbi_rope.tasks.hemodynamics import generation
from sbi_rope.tasks.hemodynamics.__main__ import main
from sbi_rope.tasks.hemodynamics.dataset import load
from sbi_rope.tasks.hemodynamics.population import Population
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject


def hum(subject: Subject, physics: Physics) -> Beat:
    """Stand in for the solver."""
    if subject.age > 70.0:
        raise SimulationError(f"Unstable at {subject.age:g} years.")
    wave = subject.mean_pressure + 20.0 * np.cos(2 * np.pi * np.arange(256) / 256)
    return Beat(
        period=subject.period,
        pressure={"radial": wave},
        period_error=0.01,
        mass_error=1e-5,
        courant=0.4 if subject.age < 30.0 else physics.courant,
    )


@pytest.fixture(autouse=True)
def _no_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "simulate_beat", hum)


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


def test_options_of_generate_reach_the_population(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "x.npz"
    options = "--height-sd 0.05 --segment-sd 0.2 --fixed-aorta"
    assert _generate(path, *options.split()) == 0
    assert load(path).settings["population"] == asdict(
        Population(height_sd=0.05, segment_sd=0.2, proximal_aorta=False)
    )


def test_errors_of_generate_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _generate(tmp_path / "x.npz", "--height-sd", "-1") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "height_sd" in line
    assert not list(tmp_path.iterdir())


def test_info_summarises_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "x.npz"
    _generate(file)
    capsys.readouterr()
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    rows = {line[:34].strip(): line[34:].split() for line in out.splitlines()}
    beats = load(file)
    systolic = float(beats.beat.amax(dim=1).mean())
    found = float(rows["systolic pressure [mmHg]"][0])
    assert found == pytest.approx(systolic, rel=1e-3)
    assert float(rows["pulse pressure [mmHg]"][0]) == pytest.approx(40.0, abs=0.1)
    assert "process: real" in out
    young = int((beats.nuisance[:, 0] < 30.0).sum())
    assert f"smaller time step: {young}\n" in out
