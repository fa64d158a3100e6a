"""Pressure waves of a subject."""

import numpy as np

from sbi_rope.tasks.hemodynamics.arteries import (
    AORTIC_ROOT,
    LEFT_BRACHIAL,
    LEFT_RADIAL,
    MMHG,
)
from sbi_rope.tasks.hemodynamics.inflow import aortic_inflow
from sbi_rope.tasks.hemodynamics.network import Network, build_network
from sbi_rope.tasks.hemodynamics.solver import Flow, mean_stored_pressure, solve
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject
from sbi_rope.utils.errors import SimulationError

NUM_PHASES = 256
# Segments count from 0 here.
SITES = {
    "radial": (LEFT_RADIAL - 1, 0.5),
    "brachial": (LEFT_BRACHIAL - 1, 0.5),
    "aortic": (AORTIC_ROOT - 1, 0.0),
}
START = 0.97  # of the mean pressure: closest to where a beat begins
NUM_INFLOW = 2000  # samples of the inflow, linear in between
ML = 1e-6  # m^3


def simulate_beat(subject: Subject, physics: Physics = Physics()) -> Beat:  # noqa: B008
    """Simulate a subject's arteries until beats repeat, and return the last one.

    A run that fails is tried again with the smaller ``physics.fallback_courant``.

    The beat begins with the opening of the aortic valve.

    Raises:
        ImportError: If numba is not installed.
        SimulationError: If the subject is impossible, or the solution is not finite
            or not periodic for the smaller Courant number either.
    """
    network = build_network(subject, physics)
    reason = ""
    for courant in (physics.courant, physics.fallback_courant):
        try:
            flow = simulate_sites(
                network, subject, physics, list(SITES.values()), courant=courant
            )
        except SimulationError as error:
            reason = str(error)
            continue
        beat = _beat(flow, subject, courant)
        if beat.period_error <= physics.max_period_error:
            return beat
        reason = (
            f"Beats {physics.num_cycles - 1} and {physics.num_cycles} differ by "
            f"{beat.period_error:.2g} mmHg; at most {physics.max_period_error:g} mmHg "
            "are allowed. Use more `num_cycles`."
        )
    raise SimulationError(reason)


def simulate_sites(
    network: Network,
    subject: Subject,
    physics: Physics,
    sites: list[tuple[int, float]],
    *,
    courant: float | None = None,
) -> Flow:
    """Simulate a subject's network and return the last beat at any sites."""
    pressure = START * subject.mean_pressure * MMHG
    return solve(
        network,
        aortic_inflow(subject, NUM_INFLOW) * ML,
        subject.period,
        sites=sites,
        start_pressure=pressure,
        stored_pressure=mean_stored_pressure(network, pressure),
        cell_length=physics.cell_length,
        courant=physics.courant if courant is None else courant,
        num_cycles=physics.num_cycles,
        convection=physics.convection,
    )


def _beat(flow: Flow, subject: Subject, courant: float) -> Beat:
    waves = flow.at(np.arange(NUM_PHASES) / NUM_PHASES) / MMHG
    pressure = dict(zip(SITES, waves, strict=True))
    error = np.abs(flow.pressure[0] - flow.previous[0]).max() / MMHG
    return Beat(
        period=subject.period,
        pressure=pressure,
        period_error=float(error),
        mass_error=abs(flow.volume_in - flow.volume_out) / flow.volume_in,
        courant=courant,
    )
