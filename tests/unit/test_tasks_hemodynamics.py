"""Recordings of stored beats, and the task made of them."""

import math

import pytest
import torch

from sbi_rope.tasks.hemodynamics.records import NUM_STEPS, Recorder, play
from sbi_rope.tasks.hemodynamics.task import Hemodynamics


def sine(num_phases: int = 256) -> torch.Tensor:
    phase = torch.arange(num_phases, dtype=torch.float64) / num_phases
    return (2 * math.pi * phase).sin().unsqueeze(0)


# Recordings --------------------------------------------------------------------------


def test_a_beat_is_repeated_at_125_hz() -> None:
    time = torch.arange(NUM_STEPS, dtype=torch.float64) / 125
    for period in (0.4, 0.8123, 1.5):
        for start in (0.0, 0.3, 0.999):
            played = play(sine(), torch.tensor([period]), start=torch.tensor([start]))
            expected = (2 * math.pi * (start + time / period)).sin()
            # Linear interpolation of a sine between 256 points is off by at most
            # (pi / 256)^2 / 2.
            torch.testing.assert_close(played[0], expected, atol=1e-4, rtol=0.0)


def test_recordings_have_mean_0_and_standard_deviation_1_before_the_noise() -> None:
    beat = 90 + 20 * sine().expand(5, -1)
    x = Recorder(noise_std=0.0)(beat, torch.linspace(0.5, 1.2, 5))
    torch.testing.assert_close(
        x.mean(dim=1), torch.zeros(5).double(), atol=1e-9, rtol=0
    )
    torch.testing.assert_close(x.std(dim=1, correction=0), torch.ones(5).double())


def test_global_normalisation_keeps_level_and_height() -> None:
    beat = torch.stack([90 + 20 * sine()[0], 100 + 30 * sine()[0]])
    recorder = Recorder(noise_std=0.0, normalisation="global")
    x = recorder(beat, torch.full((2,), 0.8))
    highest, lowest = torch.tensor([15.0, 35.0]) / 25, torch.tensor([-25.0, -25.0]) / 25
    torch.testing.assert_close(x.amax(dim=1).float(), highest, atol=1e-3, rtol=0)
    torch.testing.assert_close(x.amin(dim=1).float(), lowest, atol=1e-3, rtol=0)


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
    assert torch.equal(
        x, simulator.recorder(simulator.beat[nearest], simulator.period[nearest])
    )


def test_every_stored_person_is_simulated_before_one_comes_again() -> None:
    task = Hemodynamics()
    stored = task.get_simulator().theta
    theta, _ = task.get_simulations(len(stored))
    assert len(theta.unique(dim=0)) == len(stored)
    more, _ = task.get_simulations(len(stored) + 50)
    assert torch.equal(more[: len(stored)], theta)


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
