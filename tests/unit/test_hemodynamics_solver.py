"""The solver of blood flow, on small networks, and the beats made with it."""

import numpy as np
import pytest

from sbi_rope.tasks.hemodynamics import waveforms
from sbi_rope.tasks.hemodynamics.network import Network
from tests.blood_flow import BASELINE, REST, make_network, run, small_wave_error

pytest.importorskip("numba")

PERIOD = 0.8  # s
SPEED = np.sqrt(2 / 3 * 6e4 / 1060)  # of waves in the tubes below, m/s
HALF_SINE = np.maximum(np.sin(np.linspace(0, 2 * np.pi, 400, endpoint=False)), 0)


def loop(*, viscosity: float = 0.0, turned: tuple[int, ...] = ()) -> Network:
    """Return a tube that divides, whose branches meet again, with an outlet on one."""
    nodes = [(0, 1), (1, 2), (1, 3), (2, 3), (3, 4), (2, 5)]
    radius = [(0.01, 0.009), *[(0.006, 0.005)] * 4, (0.004, 0.004)]
    for k in turned:
        nodes[k], radius[k] = nodes[k][::-1], radius[k][::-1]
    return make_network(
        nodes,
        length=[0.1, 0.05, 0.12, 0.03, 0.2, 0.1],
        radius=radius,
        outlets=[4, 5],
        viscosity=viscosity,
        friction=6e-5,
    )


@pytest.mark.medium
@pytest.mark.parametrize("viscosity", [0.0, 0.6])
def test_tapered_arteries_at_rest_stay_at_rest(viscosity: float) -> None:
    flow = run(loop(viscosity=viscosity), np.zeros(10), PERIOD, num_cycles=5)
    np.testing.assert_allclose(flow.pressure, REST, rtol=1e-9)


@pytest.mark.parametrize("viscosity", [0.0, 0.6])
def test_a_steady_flow_loses_pressure_by_friction_only(viscosity: float) -> None:
    friction, current = 6e-5, 2e-5
    tube = make_network(
        [(0, 1)],
        length=[0.3],
        radius=[(0.008, 0.005)],
        outlets=[0],
        viscosity=viscosity,
        friction=friction,
        resistance=(5e7, 5e7),
    )
    options = {"num_cycles": 60, "cell_length": 0.005, "convection": 0.0}
    sites = [(0, 0.0), (0, 1.0)]
    flow = run(tube, np.full(10, current), PERIOD, sites=sites, **options)
    start, end = flow.pressure.mean(axis=1)
    assert end - REST == pytest.approx(1e8 * current, rel=1e-5)
    # dp/dx = -rho f Q / A^2, where the tube is as wide as its pressure makes it.
    position = (np.arange(1000) + 0.5) / 1000
    radius = tube.radius(0, position)
    pressure = start + (end - start) * position - REST
    root = np.sqrt(np.pi) * radius + pressure / tube.tube_law(0, radius)
    expected = 0.3 * (1060 * friction * current / root**4).mean()
    assert start - end == pytest.approx(expected, rel=2e-3)


def test_a_windkessel_empties_exponentially() -> None:
    # A short tube that is stiff compared with the compliance behind it.
    tube = make_network(
        [(0, 1)], length=[0.01], radius=[(1e-3, 1e-3)], outlets=[0], resistance=(1, 3e8)
    )
    flow = run(tube, np.zeros(10), PERIOD, pressure=2 * REST)
    time = np.arange(flow.pressure.shape[1]) / flow.pressure.shape[1] * PERIOD
    decay = np.exp(-(time + 2 * PERIOD) / (3e8 * 1e-9))
    np.testing.assert_allclose(flow.pressure[0] / REST, 1 + decay, rtol=2e-3)


@pytest.mark.parametrize("viscosity", [0.0, 0.6])
def test_no_volume_is_lost_in_branches_and_loops(viscosity: float) -> None:
    flow = run(loop(viscosity=viscosity), 1e-4 * HALF_SINE, PERIOD)
    change = flow.volume_in - flow.volume_out
    assert abs(change) > 1e-8
    assert flow.volume_change == pytest.approx(change, abs=1e-12 * flow.volume_in)


def test_it_does_not_matter_which_end_of_a_segment_is_its_inlet() -> None:
    network, mirrored = (loop(viscosity=0.6, turned=k) for k in ((), (1, 2, 3)))
    # With coarse cells, some segments have no point but their ends.
    first, second = (
        run(some, 1e-4 * HALF_SINE, PERIOD, sites=[site, (4, 0.5)], cell_length=0.04)
        for some, site in ((network, (2, 0.25)), (mirrored, (2, 0.75)))
    )
    np.testing.assert_allclose(first.pressure, second.pressure, rtol=1e-9)


def test_waves_have_the_velocity_of_the_tube_law_and_bifurcations_reflect() -> None:
    radius = np.array([0.01, 0.006, 0.005])
    tubes = make_network(
        [(0, 1), (1, 2), (1, 3)],
        length=[2.0] * 3,
        radius=[(r, r) for r in radius],
        outlets=[1, 2],
    )
    # It passes the middle of the first tube before and after it is reflected.
    pulse = np.zeros(400)
    pulse[:25] = np.sin(np.linspace(0, np.pi, 25)) ** 2
    changes = {"num_cycles": 2, "convection": 0.0, "cell_length": 0.005}
    flow = run(tubes, 1e-7 * pulse, PERIOD, sites=[(0, 0.1), (0, 0.5)], **changes)
    time = np.arange(flow.previous.shape[1]) / flow.previous.shape[1] * PERIOD
    early = time < 2.0 / SPEED + 0.025
    first, second = time[flow.previous[:, early].argmax(axis=1)]
    assert second - first == pytest.approx(0.8 / SPEED, rel=5e-3)
    wave = flow.previous[1] - REST
    reflected = wave[~early]
    measured = reflected[np.abs(reflected).argmax()] / wave[early].max()
    branches = (radius[1:] ** 2).sum()
    exact = (radius[0] ** 2 - branches) / (radius[0] ** 2 + branches)
    assert exact > 0.2
    assert measured == pytest.approx(exact, abs=0.01)


@pytest.mark.parametrize(
    ("viscosity", "cell_length"), [(0.0, 0.01), (0.3, 0.025), (3.0, 0.01)]
)
def test_small_waves_in_a_loop_are_those_of_the_linear_equations(
    viscosity: float, cell_length: float
) -> None:
    error = small_wave_error(
        loop(viscosity=viscosity),
        1e-8 * HALF_SINE,
        PERIOD,
        pressure=REST,
        sites=[(0, 0.0), (2, 0.5), (4, 0.5), (5, 1.0)],
        num_cycles=12,
        cell_length=cell_length,
    )
    assert error < 0.015


@pytest.mark.medium
def test_a_beat_begins_at_the_valve_and_reaches_the_elbow_before_the_wrist() -> None:
    pressure = waveforms.simulate_beat(BASELINE).pressure
    assert pressure["aortic"].argmin() in (*range(250, 256), *range(6))
    rise = {name: np.diff(wave).argmax() for name, wave in pressure.items()}
    assert rise["aortic"] < rise["brachial"] < rise["radial"]
