"""The arteries of a person, and small waves in them."""

from dataclasses import replace

import numpy as np
import pytest

from sbi_rope.tasks.hemodynamics import arteries
from sbi_rope.tasks.hemodynamics.arteries import MMHG
from sbi_rope.tasks.hemodynamics.network import (
    build_network,
    carotid_femoral_velocity,
    wave_speed,
)
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Physics
from tests.blood_flow import BASELINE
from tests.conftest import SHARED_DATA

# The tables --------------------------------------------------------------------------


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the published table is not here")
def test_the_geometry_is_the_published_one() -> None:
    path = SHARED_DATA / "hemodynamics" / "pwdb_116_arteries.csv"
    lines = path.read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")][1:]
    expected = np.array([[float(x) for x in line.split(",")[1:6]] for line in lines])
    table = arteries.SEGMENTS.T
    np.testing.assert_allclose(table, expected * [1, 1, 1e3, 1e3, 1e3])


def test_every_blind_end_has_a_vascular_bed_and_nothing_else_has() -> None:
    ends = [node for segment in arteries.SEGMENTS.T for node in segment[:2]]
    blind = {
        i
        for i, segment in enumerate(arteries.SEGMENTS.T, start=1)
        if ends.count(segment[1]) == 1
    }
    in_beds = [segment for bed in arteries.BEDS for segment in bed[0]]
    assert sorted(in_beds) == sorted(blind)


# Stiffness ---------------------------------------------------------------------------


def test_the_walls_give_the_wave_velocity_asked_for() -> None:
    factors = tuple(1 + 0.2 * np.sin(np.arange(NUM_SEGMENTS)))
    for velocity, diameter in ((4.0, 1.2), (6.1, 0.8), (11.0, 1.2)):
        subject = replace(
            BASELINE,
            pulse_wave_velocity=velocity,
            diameter_factor=diameter,
            length_factors=factors,
        )
        network = build_network(subject, Physics())
        measured = carotid_femoral_velocity(
            network.length,
            network.inlet_radius,
            network.outlet_radius,
            network.stiffness[2, 0],
        )
        assert measured == pytest.approx(velocity, rel=1e-6)


def test_the_ways_end_in_the_middle_of_the_carotid_and_of_the_femoral_artery() -> None:
    radius = np.full((2, NUM_SEGMENTS), 0.004)
    radius[:, 15 - 1] = 0.003, 0.005  # 0.0035 in the middle of its first half
    length = np.full(NUM_SEGMENTS, 0.1)

    def speed(radius: float) -> float:
        return float(np.sqrt(2 / 3 * (3e5 * np.exp(-1350 * radius) + 4e4) / 1060))

    # Two segments and a half to the carotid, twelve and a half to the femoral artery.
    carotid = 0.2 / speed(0.004) + 0.05 / speed(0.0035)
    expected = (1.25 - 0.25) / (1.25 / speed(0.004) - carotid)
    measured = carotid_femoral_velocity(length, *radius, 4e4)
    assert measured == pytest.approx(expected, rel=1e-12)


def test_a_wave_velocity_follows_from_the_tube_law() -> None:
    network = build_network(BASELINE, Physics())
    radius = np.array([0.01, 0.012])
    # c^2 = A / rho dp/dA = sqrt(A) (beta / A_d) / (2 rho)
    slope = network.tube_law(0, radius)
    expected = np.sqrt(np.sqrt(np.pi) * radius * slope / (2 * network.density))
    found = wave_speed(radius, network.stiffness[2, 0])
    np.testing.assert_allclose(found, expected)


# Vascular beds -----------------------------------------------------------------------


def test_all_outlets_together_have_the_resistance_of_the_target_pressure() -> None:
    network = build_network(BASELINE, Physics())
    outlets = network.outlets
    total = outlets.proximal_resistance + outlets.distal_resistance
    flow = BASELINE.stroke_volume * 1e-6 / BASELINE.period
    pressure = outlets.pressure + flow / (1 / total).sum()
    assert pressure / MMHG == pytest.approx(BASELINE.mean_pressure)


def test_most_outlets_have_the_impedance_of_their_artery() -> None:
    network = build_network(BASELINE, Physics())
    segment, radius = network.outlets.segment, network.outlet_radius
    speed = wave_speed(radius[segment], network.stiffness[2, 0])
    impedance = 1060 * speed / (np.pi * radius[segment] ** 2)
    matched = np.isclose(network.outlets.proximal_resistance, impedance)
    assert set(segment[~matched] + 1) <= {26}
