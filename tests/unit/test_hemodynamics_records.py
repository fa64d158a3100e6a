"""Stored beats: made in parallel, read, recorded, and the task made of them."""

import importlib
import math
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch

from sbi_rope.tasks.hemodynamics import generation
from sbi_rope.tasks.hemodynamics.__main__ import main
from sbi_rope.tasks.hemodynamics.dataset import load
from sbi_rope.tasks.hemodynamics.population import NUISANCES, Population
from sbi_rope.tasks.hemodynamics.records import NUM_STEPS, Recorder, play
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject
from sbi_rope.tasks.hemodynamics.task import Hemodynamics
from sbi_rope.utils.errors import SimulationError
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


def make(path: Path, *, jobs: int = 1) -> int:
    """Run the command with the stand-in."""
    options = f"generate --n {N} --process real --seed 4 --jobs {jobs} --out {path}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "simulate_beat", hum)
        return main(options.split())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("beats") / "real.npz"
    assert make(path) == 0
    return path


def test_rows_belong_to_the_first_people_who_can_be_simulated(made: Path) -> None:
    beats = load(made)
    people: list[Subject] = []
    while sum(person.age <= 70.0 for person in people) < N:
        people.append(Population().draw("real", seed=4, index=len(people)))
    accepted = [i for i, person in enumerate(people) if person.age <= 70.0]
    assert beats.index.tolist() == accepted
    reason = "The flow broke down after # years"
    assert beats.rejected == {reason: len(people) - N}
    assert len(people) > N
    for row in (0, 17, N - 1):
        subject = people[accepted[row]]
        for found, expected in (
            (beats.beat, hum(subject, Physics()).pressure["radial"]),
            (beats.theta, [subject.stroke_volume, subject.ejection_time]),
            (beats.nuisance, [getattr(subject, name) for name in NUISANCES]),
            (beats.length_factors, subject.length_factors),
            (beats.period, subject.period),
        ):
            np.testing.assert_allclose(found[row], expected, rtol=1e-6)
    assert beats.beat.dtype == beats.theta.dtype == torch.float32


def test_the_command_writes_the_same_bytes_with_any_number_of_jobs_and_only_once(
    made: Path, tmp_path: Path, terminal: pytest.CaptureFixture[str]
) -> None:
    again = tmp_path / "again.npz"
    with joblib.parallel_config(backend="threading"):
        assert make(again, jobs=2) == 0
    assert again.read_bytes() == made.read_bytes()
    assert list(tmp_path.iterdir()) == [again]
    captured = terminal.readouterr()
    rejected = sum(load(made, process="real").rejected.values())
    assert f"{N} people, {rejected} rejected" in captured.out
    assert f"{N}/{N}" in captured.err  # of the progress bar
    assert make(made) == 2
    assert "Expected no file" in terminal.readouterr().err


@pytest.mark.medium
def test_stored_beats_load_without_numba(made: Path) -> None:
    with imported_anew(without=("numba",)):
        dataset = importlib.import_module("sbi_rope.tasks.hemodynamics.dataset")
        command = importlib.import_module("sbi_rope.tasks.hemodynamics.__main__")
        assert dataset.load is not load
        assert len(dataset.load(made)) == N
        assert command.main(["info", str(made)]) == 0


# Recordings --------------------------------------------------------------------------


def sine() -> torch.Tensor:
    phase = torch.arange(256, dtype=torch.float64) / 256
    return (2 * math.pi * phase).sin().unsqueeze(0)


def test_a_beat_is_repeated_at_125_hz() -> None:
    time = torch.arange(NUM_STEPS, dtype=torch.float64) / 125
    for period in (0.4, 0.8123, 1.5):
        for start in (0.0, 0.3, 0.999):
            played = play(sine(), torch.tensor([period]), start=torch.tensor([start]))
            expected = (2 * math.pi * (start + time / period)).sin()
            # Linear interpolation of a sine between 256 points is off by at most
            # (pi / 256)^2 / 2.
            torch.testing.assert_close(played[0], expected, atol=1e-4, rtol=0.0)


def test_recordings_are_normalised_each_or_all_alike() -> None:
    beat = torch.stack([90 + 20 * sine()[0], 100 + 30 * sine()[0]])
    periods = torch.tensor([0.7, 0.8])
    each = Recorder(noise_std=0.0)(beat, periods)
    both = Recorder(noise_std=0.0, normalisation="global")(beat, periods)
    for found, expected, atol in (
        (each.mean(dim=1), [0.0, 0.0], 1e-9),
        (each.std(dim=1, correction=0), [1.0, 1.0], 1e-6),
        (both.amax(dim=1), [15 / 25, 35 / 25], 1e-3),
        (both.amin(dim=1), [-25 / 25, -25 / 25], 1e-3),
    ):
        assert found.tolist() == pytest.approx(expected, abs=atol)


def test_recordings_start_uniformly_within_the_beat() -> None:
    # The first sample of a straight ramp tells where it began.
    ramp = torch.arange(256, dtype=torch.float64).expand(4000, -1)
    recorder = Recorder(noise_std=0.0, normalisation="global")
    first = recorder(ramp, torch.full((4000,), 0.8))[:, 0] * 25 + 95
    levels = (first / 256).sort().values
    assert (levels - torch.arange(1, 4001) / 4000).abs().max() < 2 / 4000**0.5


# The task ----------------------------------------------------------------------------


def test_simulations_between_stored_parameters_are_of_the_nearest_person() -> None:
    simulator = Hemodynamics().get_simulator()
    theta = Hemodynamics().get_prior().sample(torch.Size((100,)))
    scaled = (theta.unsqueeze(1) - simulator.theta) / simulator.theta_std
    nearest = scaled.square().sum(dim=2).argmin(dim=1)
    torch.manual_seed(0)
    x = simulator(theta)
    torch.manual_seed(0)
    expected = simulator.recorder(simulator.beat[nearest], simulator.period[nearest])
    assert torch.equal(x, expected)


def test_every_stored_person_is_simulated_before_one_comes_again() -> None:
    task = Hemodynamics()
    num_people = len(task.get_simulator().theta)
    theta, _ = task.get_simulations(num_people + 50)
    assert len(theta[:num_people].unique(dim=0)) == num_people


def test_well_specified_observations_are_of_people_who_are_not_trained_on() -> None:
    task = Hemodynamics(variant="well_specified")
    trained = {tuple(row) for row in task.get_simulator().theta.tolist()}
    people = [task.get_calibration_set(50)[0], task.get_test_set(100)[0]]
    assert not trained & {tuple(row) for row in torch.cat(people).tolist()}
    half = len(Hemodynamics().get_simulator().theta) / 2
    assert len(trained) == pytest.approx(half, abs=1)


def test_the_people_of_the_package_have_the_pressures_of_the_literature() -> None:
    for process in ("simulator", "real"):
        beat = Hemodynamics()._load(None, process).beat
        systolic, diastolic = beat.amax(dim=1), beat.amin(dim=1)
        # Means over the population as in the study that the design follows.
        assert systolic.mean() == pytest.approx(124, abs=4)
        assert diastolic.mean() == pytest.approx(74, abs=3)
        assert (systolic - diastolic).mean() == pytest.approx(50, abs=5)
        assert beat.mean() == pytest.approx(95, abs=3)
        assert 30 < beat.min() < beat.max() < 220
