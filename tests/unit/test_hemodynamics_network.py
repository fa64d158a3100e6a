"""The arteries of a person, small waves in them, and the flow out of the heart."""

from dataclasses import replace

import numpy as np
import pytest

from sbi_rope.tasks.hemodynamics import arteries, inflow
from sbi_rope.tasks.hemodynamics.arteries import MMHG
from sbi_rope.tasks.hemodynamics.inflow import aortic_inflow
from sbi_rope.tasks.hemodynamics.network import (
    build_network,
    carotid_femoral_velocity,
    wave_speed,
)
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Physics
from tests.blood_flow import BASELINE
from tests.conftest import SHARED_DATA, TEST_DATA


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the published table is not here")
def test_the_geometry_is_the_published_one() -> None:
    path = SHARED_DATA / "hemodynamics" / "pwdb_116_arteries.csv"
    lines = path.read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")][1:]
    expected = np.array([[float(x) for x in line.split(",")[1:6]] for line in lines])
    table = arteries.SEGMENTS.T
    np.testing.assert_allclose(table, expected * [1, 1, 1e3, 1e3, 1e3])


def test_every_blind_end_has_a_vascular_bed_and_nothing_else_has() -> None:
    ends = arteries.SEGMENTS[:2].flatten().tolist()
    outlets = arteries.SEGMENTS[1].tolist()
    blind = [i for i, node in enumerate(outlets, start=1) if ends.count(node) == 1]
    assert sorted(segment for bed in arteries.BEDS for segment in bed[0]) == blind


def test_the_walls_give_the_wave_velocity_asked_for() -> None:
    factors = tuple(1 + 0.2 * np.sin(np.arange(NUM_SEGMENTS)))
    for velocity, diameter in ((4.0, 1.2), (6.1, 0.8), (11.0, 1.2)):
        subject = replace(BASELINE, diameter_factor=diameter, length_factors=factors)
        subject = replace(subject, pulse_wave_velocity=velocity)
        network = build_network(subject, Physics())
        radii = network.inlet_radius, network.outlet_radius
        stiffness = network.stiffness[2, 0]
        measured = carotid_femoral_velocity(network.length, *radii, stiffness)
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


def test_outlets_have_the_resistance_of_the_target_and_match_their_artery() -> None:
    network = build_network(BASELINE, Physics())
    outlets = network.outlets
    total = outlets.proximal_resistance + outlets.distal_resistance
    flow = BASELINE.stroke_volume * 1e-6 / BASELINE.period
    pressure = outlets.pressure + flow / (1 / total).sum()
    assert pressure / MMHG == pytest.approx(BASELINE.mean_pressure)
    # Waves leave all outlets but one without a reflection.
    radius = network.outlet_radius[outlets.segment]
    impedance = 1060 * wave_speed(radius, network.stiffness[2, 0]) / (np.pi * radius**2)
    matched = np.isclose(outlets.proximal_resistance, impedance)
    assert set(outlets.segment[~matched] + 1) <= {26}


# Flow out of the heart ---------------------------------------------------------------

SUBJECTS = [
    BASELINE,
    replace(BASELINE, heart_rate=48.0, stroke_volume=95.0, ejection_time=345.0),
    replace(BASELINE, heart_rate=120.0, stroke_volume=25.0, ejection_time=220.0),
    replace(BASELINE, peak_flow_time=110.0, regurgitant_volume=2.5),
    replace(BASELINE, regurgitant_volume=0.0),
]


def test_a_beat_ejects_the_stroke_volume_and_the_reverse_flow_comes_back() -> None:
    for subject in SUBJECTS:
        volume = subject.period * aortic_inflow(subject, 4000) / 4000
        assert volume.sum() == pytest.approx(subject.stroke_volume, rel=1e-5)
        returned, expected = -volume.clip(max=0.0).sum(), subject.regurgitant_volume
        assert returned == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_flow_peaks_turns_and_ends_when_it_should() -> None:
    for subject in SUBJECTS:
        flow = aortic_inflow(subject, 20_000)
        time = 1000 * subject.period * np.arange(20_000) / 20_000
        step, last = time[1], subject.ejection_time
        peak = time[flow.argmax()]
        assert peak == pytest.approx(subject.peak_flow_time, abs=2 * step)
        ejected = time[flow > 0]
        assert ejected[0] == pytest.approx(0.0, abs=2 * step)
        assert ejected[-1] == pytest.approx(last, abs=2 * step)
        end = 309 / 282 * last
        assert (flow[(time > last) & (time < end)] <= 0).all()
        assert (flow[time >= end] == 0).all()


def test_the_table_reproduces_the_published_waveform() -> None:
    path = TEST_DATA / "hemodynamics" / "inflow_template_mynard2015.csv"
    time, published = np.loadtxt(path, delimiter=",", skiprows=2, unpack=True)
    ours = inflow._template().spline(time)
    np.testing.assert_allclose(ours, published, rtol=0, atol=0.002 * published.max())
    forward = published.clip(min=0.0).sum()
    assert ours.clip(min=0.0).sum() == pytest.approx(forward, rel=1e-4)
