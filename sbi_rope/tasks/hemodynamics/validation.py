r"""Compares simulated waves with openBF, exact solutions and finer simulations."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sbi_rope.tasks.hemodynamics.arteries import (
    CAROTID_PATH,
    FEMORAL_PATH,
    MMHG,
)
from sbi_rope.tasks.hemodynamics.inflow import aortic_inflow
from sbi_rope.tasks.hemodynamics.linear import linear_pressure
from sbi_rope.tasks.hemodynamics.network import Network, Outlets, build_network
from sbi_rope.tasks.hemodynamics.openbf import CASES, openbf_error
from sbi_rope.tasks.hemodynamics.solver import Flow, solve
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Beat, Physics, Subject
from sbi_rope.tasks.hemodynamics.waveforms import (
    SITES,
    simulate_beat,
    simulate_sites,
)

__all__ = [
    "BASELINE",
    "Row",
    "linear_error",
    "mass_error",
    "refinement_error",
    "reflection",
    "validation_table",
    "velocity_error",
]

# A man of 25, all parameters at their means.
BASELINE = Subject(
    age=25.0,
    heart_rate=73.0,
    stroke_volume=66.3,
    ejection_time=282.0,
    peak_flow_time=79.0,
    regurgitant_volume=0.73,
    mean_pressure=89.0,
    diastolic_pressure=75.0,
    outflow_pressure=33.2,
    pulse_wave_velocity=6.1,
    diameter_factor=1.0,
    compliance_factor=1.0,
    length_factors=(1.0,) * NUM_SEGMENTS,
)
OPENBF_GOALS = {"cca": 1.0, "ibif": 1.5, "adan56": 3.0}  # %
VELOCITIES = (5.5, 6.1, 8.0, 11.0)  # m/s
SMALL = 0.01  # of the pulsation, where waves are linear
NUM_HARMONICS = 60
NUM_SAMPLES = 2000
ML = 1e-6  # m^3


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the validation table.

    Attributes:
        name: What is compared.
        measured: The number, or None if the comparison was not run.
        goal: What it should be.
        unit: Of both.
        passed: Whether it is, or None.
    """

    name: str
    measured: float | None
    goal: str
    unit: str
    passed: bool | None


def validation_table(reference: Path | None) -> list[Row]:
    """Run all comparisons, in about 10 s.

    Args:
        reference: Folder with networks and pressures of openBF, or None, which leaves
            these rows open.
    """
    return [*_openbf_rows(reference), *_exact_rows(), *_baseline_rows()]


def linear_error(*, viscoelastic: bool, cell_length: float = 0.01) -> float:
    """Return the difference from the exact small waves, in % of their rms.

    The largest over the sites. Without mean flow and with a mean pressure that is the
    same everywhere, since the exact solution is one of small waves around rest.
    """
    physics = Physics(viscoelastic=viscoelastic)
    network = build_network(BASELINE, physics)
    rest = BASELINE.mean_pressure * MMHG
    network = replace(network, outlets=replace(network.outlets, pressure=rest))
    inflow = SMALL * ML * aortic_inflow(BASELINE, NUM_SAMPLES)
    sites = list(SITES.values())
    flow = solve(
        network,
        inflow - inflow.mean(),
        BASELINE.period,
        sites=sites,
        start_pressure=rest,
        stored_pressure=np.full(len(network.outlets.segment), rest),
        cell_length=cell_length,
        courant=physics.courant,
        num_cycles=physics.num_cycles,
        convection=0.0,
    )
    exact = linear_pressure(
        *(network, inflow, BASELINE.period),
        pressure=rest,
        sites=sites,
        num_harmonics=NUM_HARMONICS,
    )
    waves = flow.at(np.arange(NUM_SAMPLES) / NUM_SAMPLES)
    waves -= waves.mean(axis=1, keepdims=True)
    error = np.sqrt(((waves - exact) ** 2).mean(axis=1))
    return float(100 * (error / exact.std(axis=1)).max())


def mass_error(flow: Flow) -> float:
    """Return what is lost of the volume that came in, as a fraction of it."""
    lost = flow.volume_in - flow.volume_out - flow.volume_change
    return abs(lost) / flow.volume_in


def velocity_error(velocity: float, *, viscoelastic: bool) -> float:
    """Return the error of the velocity from foot to foot of the wave, in % of it.

    Between the carotid and the femoral artery; a foot is where the steepest tangent
    meets the diastolic pressure. Viscous walls spread a wave the more the farther it
    goes, and so its foot comes early at the femoral artery.
    """
    subject = replace(BASELINE, pulse_wave_velocity=velocity)
    physics = Physics(viscoelastic=viscoelastic)
    network = build_network(subject, physics)
    paths = [np.array(path) - 1 for path in (CAROTID_PATH, FEMORAL_PATH)]
    sites = [(int(path[-1]), 0.5) for path in paths]
    flow = simulate_sites(network, subject, physics, sites)
    carotid, femoral = (_foot(wave, subject.period) for wave in flow.pressure)
    distance = [network.length[p].sum() - network.length[p[-1]] / 2 for p in paths]
    measured = (distance[1] - distance[0]) / (femoral - carotid)
    return float(100 * abs(measured / velocity - 1))


def refinement_error() -> float:
    """Return the difference of the radial wave for cells of 2 and 0.5 cm, in mmHg."""
    coarse, fine = (
        simulate_beat(BASELINE, Physics(cell_length=length)).pressure["radial"]
        for length in (0.02, 0.005)
    )
    return float(np.abs(coarse - fine).max())


def reflection() -> tuple[float, float]:
    r"""Return the reflection at a bifurcation, as simulated and as it should be.

    .. math:: \frac{Y_0 - Y_1 - Y_2}{Y_0 + Y_1 + Y_2}, \qquad Y = \frac{A}{\rho c}

    A pulse much shorter than the tubes passes the middle of the first one before and
    after it is reflected.
    """
    radius, rest = np.array([0.01, 0.006, 0.005]), 1e4
    network = _bifurcation(radius, rest)
    speed = [float(network.wave_speed(k, r)) for k, r in enumerate(radius)]
    duration, period = 0.05, 1.2 * network.length[0] / speed[0] * 2
    time = np.arange(NUM_SAMPLES) / NUM_SAMPLES * period
    pulse = np.where(time < duration, np.sin(np.pi * time / duration) ** 2, 0.0)
    flow = solve(
        *(network, 1e-7 * pulse, period),
        sites=[(0, 0.5)],
        start_pressure=rest,
        stored_pressure=np.full(2, rest),
        cell_length=0.005,
        courant=0.6,
        num_cycles=2,
        convection=0.0,
    )
    wave = flow.before(time / period)[0] - rest
    turn = network.length[0] / speed[0] + duration / 2
    incident, reflected = wave[time < turn], wave[time >= turn]
    measured = reflected[np.abs(reflected).argmax()] / incident.max()
    admittance = np.pi * radius**2 / (network.density * np.array(speed))
    branches = admittance[1:].sum()
    exact = (admittance[0] - branches) / (admittance[0] + branches)
    return float(measured), float(exact)


def _bifurcation(radius: np.ndarray, rest: float) -> Network:
    """Return three cylinders of 2 m at a node, without friction."""
    zeros = np.zeros(3)
    outlets = Outlets(
        segment=np.array([1, 2]),
        proximal_resistance=np.full(2, 1e8),
        distal_resistance=np.full(2, 1e9),
        compliance=np.full(2, 1e-10),
        pressure=rest,
    )
    return Network(
        inlet_node=np.array([0, 1, 1]),
        outlet_node=np.array([1, 2, 3]),
        length=np.full(3, 2.0),
        inlet_radius=radius,
        outlet_radius=radius,
        stiffness=np.stack([zeros, zeros, np.array([6e4, 8e4, 8e4])]),
        wall_viscosity=np.stack([zeros, zeros]),
        reference_pressure=np.full(3, rest),
        friction=zeros,
        density=1060.0,
        source_node=0,
        outlets=outlets,
    )


def _openbf_rows(reference: Path | None) -> Iterator[Row]:
    for case in CASES:
        error = None if reference is None else openbf_error(reference, case)
        yield _row(f"openBF {case}, pressure", error, OPENBF_GOALS[case], "% of mean")


def _exact_rows() -> Iterator[Row]:
    for viscoelastic in (False, True):
        walls = "viscoelastic" if viscoelastic else "elastic"
        error = linear_error(viscoelastic=viscoelastic)
        yield _row(f"linear waves, {walls}", error, 3.0, "% of rms")
    measured, exact = reflection()
    yield _row("reflection at a bifurcation", abs(measured - exact), 0.01, "")
    for viscoelastic in (False, True):
        walls = "viscoelastic" if viscoelastic else "elastic"
        for velocity in VELOCITIES:
            error = velocity_error(velocity, viscoelastic=viscoelastic)
            yield _row(f"wave velocity {velocity:g} m/s, {walls}", error, 8.0, "%")


def _baseline_rows() -> Iterator[Row]:
    physics = Physics()
    network = build_network(BASELINE, physics)
    flow = simulate_sites(network, BASELINE, physics, list(SITES.values()))
    yield _row("mass lost", mass_error(flow), 1e-4, "of inflow")
    beat = simulate_beat(BASELINE, physics)
    yield _row("difference of the last two beats", beat.period_error, 0.3, "mmHg")
    yield _row("cells of 2 cm and 0.5 cm", refinement_error(), 1.0, "mmHg")
    yield from _pressure_rows(beat)


def _pressure_rows(beat: Beat) -> Iterator[Row]:
    aortic, radial = beat.pressure["aortic"], beat.pressure["radial"]
    excess = abs(aortic.mean() - BASELINE.mean_pressure)
    yield _row("mean pressure and its target", excess, 3.0, "mmHg")
    amplification = np.ptp(radial) / np.ptp(aortic)
    for name, value, low, high in (
        ("aortic systolic", aortic.max(), 97.0, 107.0),
        ("aortic diastolic", aortic.min(), 72.0, 80.0),
        ("radial systolic", radial.max(), 112.0, 124.0),
        ("radial diastolic", radial.min(), 69.0, 77.0),
    ):
        yield _row(f"{name}, 25 years", value, high, "mmHg", low=low)
    yield _row("radial to aortic pulse", amplification, 1.9, "", low=1.5)


def _row(
    name: str, measured: float | None, high: float, unit: str, *, low: float = -math.inf
) -> Row:
    goal = f"< {high:g}" if math.isinf(low) else f"{low:g} to {high:g}"
    if measured is None:
        return Row(name=name, measured=None, goal=goal, unit=unit, passed=None)
    measured = float(measured)
    passed = low <= measured <= high
    return Row(name=name, measured=measured, goal=goal, unit=unit, passed=passed)


def _foot(wave: np.ndarray, period: float) -> float:
    """Return when the steepest tangent of a wave meets its minimum, in s."""
    slope = np.gradient(wave, period / len(wave))
    steepest = int(slope.argmax())
    rise = (wave[steepest] - wave.min()) / slope[steepest]
    return steepest * period / len(wave) - float(rise)
