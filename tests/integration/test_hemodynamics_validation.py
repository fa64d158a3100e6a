"""Simulated blood flow against openBF, exact solutions and what is physiological.

The numbers are in ``docs/background/hemodynamics.md``.
"""

from dataclasses import replace

import numpy as np
import pytest

from sbi_rope.tasks.hemodynamics.arteries import CAROTID_PATH, FEMORAL_PATH, MMHG
from sbi_rope.tasks.hemodynamics.inflow import aortic_inflow
from sbi_rope.tasks.hemodynamics.network import build_network
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics
from sbi_rope.tasks.hemodynamics.waveforms import SITES, simulate_beat, simulate_sites
from tests.blood_flow import BASELINE, openbf_error, small_wave_error
from tests.conftest import SHARED_DATA, TEST_DATA

pytest.importorskip("numba")


# All stored waves of openBF, those of its largest network included.
OPENBF = SHARED_DATA / "hemodynamics" / "reference_openbf"


@pytest.fixture(scope="module")
def beat() -> Beat:
    return simulate_beat(BASELINE)


@pytest.mark.parametrize(
    ("network", "largest"),
    [("cca", 1.0), pytest.param("ibif", 1.5, marks=pytest.mark.slow)],
)
def test_pressures_in_small_networks_agree_with_those_of_openbf(
    network: str, largest: float
) -> None:
    folder = TEST_DATA / "hemodynamics" / "openbf"
    assert openbf_error(folder, network) < largest


@pytest.mark.skipif(not OPENBF.is_dir(), reason="openBF's largest network is not here")
@pytest.mark.medium
def test_pressures_in_77_arteries_come_closer_to_openbf_with_finer_cells() -> None:
    assert openbf_error(OPENBF, "adan56") < 3.0
    coarse = openbf_error(OPENBF, "adan56", cell_length=0.02)
    fine = openbf_error(OPENBF, "adan56", cell_length=0.005)
    assert fine < 0.75 * coarse


@pytest.mark.slow
@pytest.mark.parametrize("viscoelastic", [False, True])
def test_small_waves_come_closer_to_the_linear_equations_with_finer_cells(
    viscoelastic: bool,
) -> None:
    # Without mean flow and with a mean pressure that is the same everywhere, since the
    # exact solution is one of small waves around rest.
    network = build_network(BASELINE, Physics(viscoelastic=viscoelastic))
    rest = BASELINE.mean_pressure * MMHG
    coarse, usual, fine = (
        small_wave_error(
            replace(network, outlets=replace(network.outlets, pressure=rest)),
            1e-8 * aortic_inflow(BASELINE, 2000),  # m^3/s, a hundredth
            BASELINE.period,
            pressure=rest,
            sites=list(SITES.values()),
            num_cycles=10,
            cell_length=cell_length,
        )
        for cell_length in (0.02, 0.01, 0.005)
    )
    assert usual < 0.03
    assert fine < 0.6 * coarse


@pytest.mark.slow
def test_cells_of_another_length_and_shorter_steps_give_the_same_beat(
    beat: Beat,
) -> None:
    def radial(**changes: float) -> np.ndarray:
        return simulate_beat(BASELINE, Physics(**changes)).pressure["radial"]

    assert beat.period_error < 0.3
    coarse, fine = (radial(cell_length=length) for length in (0.02, 0.005))
    assert np.abs(coarse - fine).max() < 1.0
    assert np.abs(radial(courant=0.3) - beat.pressure["radial"]).max() < 0.3


def velocity_error(velocity: float, *, viscoelastic: bool) -> float:
    """Return the error of the velocity from foot to foot of the wave, in % of it.

    Between the carotid and the femoral artery; a foot is where the steepest tangent
    meets the diastolic pressure.
    """
    subject = replace(BASELINE, pulse_wave_velocity=velocity)
    physics = Physics(viscoelastic=viscoelastic)
    network = build_network(subject, physics)
    paths = [np.array(path) - 1 for path in (CAROTID_PATH, FEMORAL_PATH)]
    sites = [(int(path[-1]), 0.5) for path in paths]
    flow = simulate_sites(network, subject, physics, sites)
    feet = []
    for wave in flow.pressure:
        step = subject.period / len(wave)
        slope = np.gradient(wave, step)
        steepest = slope.argmax()
        feet.append(steepest * step - (wave[steepest] - wave.min()) / slope[steepest])
    carotid, femoral = (
        network.length[path].sum() - network.length[path[-1]] / 2 for path in paths
    )
    measured = (femoral - carotid) / (feet[1] - feet[0])
    return float(100 * abs(measured / velocity - 1))


@pytest.mark.slow
@pytest.mark.parametrize("viscoelastic", [False, True])
def test_waves_travel_at_the_velocity_asked_for(viscoelastic: bool) -> None:
    for velocity in (6.1, 8.0, 11.0):
        assert velocity_error(velocity, viscoelastic=viscoelastic) < 8.0
    # Viscous walls spread the wave on its way to the leg, so that its foot is 9 %
    # early in arteries this soft.
    softest = velocity_error(5.5, viscoelastic=viscoelastic)
    assert softest < (9.0 if viscoelastic else 8.0)


@pytest.mark.medium
def test_the_pressures_of_a_man_of_25_are_those_published(beat: Beat) -> None:
    for site, systolic, diastolic in (
        ("aortic", 102, 76),
        ("brachial", 110, 75),
        ("radial", 118, 73),
    ):
        wave = beat.pressure[site]
        assert wave.max() == pytest.approx(systolic, abs=5.0)
        assert wave.min() == pytest.approx(diastolic, abs=4.0)
