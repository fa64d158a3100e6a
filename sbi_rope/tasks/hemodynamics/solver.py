r"""One-dimensional blood flow in a network of elastic or viscoelastic tubes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_rope.tasks.hemodynamics.grid import Grid, State, build_grid
from sbi_rope.tasks.hemodynamics.network import Network
from sbi_rope.utils.errors import SimulationError

Site = tuple[int, float]


@dataclass(frozen=True, kw_only=True)
class Flow:
    """The last beat of a simulation.

    Attributes:
        pressure: At each site at the start of each of the ``n`` steps, in Pa, shape
            ``(r, n)``.
        previous: The same of the beat before.
        volume_in: Volume that came in, in m^3.
        volume_out: Volume that left through the outlets, in m^3.
        volume_change: What the volume of all arteries grew by, in m^3.
    """

    pressure: np.ndarray
    previous: np.ndarray
    volume_in: float
    volume_out: float
    volume_change: float

    def at(self, phase: np.ndarray) -> np.ndarray:
        """Return the pressures at phases from 0 to 1, shape ``(r, len(phase))``."""
        return _interpolate(self.pressure, phase)


def _interpolate(waves: np.ndarray, phase: np.ndarray) -> np.ndarray:
    own = np.arange(waves.shape[1]) / waves.shape[1]
    return np.stack([np.interp(phase, own, wave, period=1.0) for wave in waves])


def solve(
    network: Network,
    inflow: np.ndarray,
    period: float,
    *,
    sites: list[Site],
    start_pressure: float,
    stored_pressure: np.ndarray,
    cell_length: float,
    courant: float,
    num_cycles: int,
    convection: float,
) -> Flow:
    r"""Solve for area :math:`A`, flow :math:`Q` and pressure :math:`p`.

    .. math:: \partial_t A + \partial_x Q = 0, \qquad
        \partial_t Q + \partial_x \frac{\alpha Q^2}{A}
        + \frac{A}{\rho} \partial_x p = -f \frac{Q}{A}

    with the tube law of :class:`Network`. The grid is staggered in space and time:
    points have areas, faces flows. All ends of segments at a node share one pressure
    and the volume of the half cells around it, which conserves mass to rounding for
    any number of segments and in loops. Convection takes its momentum from upstream.
    The viscous part of the pressure is solved for implicitly, over the whole network.

    Args:
        network: The arteries.
        inflow: Flow into the source node, equally spaced over a beat, in m^3 s^-1.
        period: Length of a beat, in s.
        sites: Segment, counted from 0, and position along it from 0 to 1.
        start_pressure: Pressure everywhere at the start, in Pa.
        stored_pressure: Of the outlets at the start, in Pa, shape ``(k,)``.
        cell_length: Length of a cell, roughly, in m.
        courant: Courant number.
        num_cycles: Beats, of which the last two are kept.
        convection: Momentum correction :math:`\alpha`.

    Raises:
        SimulationError: If the solution is not finite.

    References:
        | Pulse wave propagation in a model human arterial network (Alastruey et al.,
          2011), for equations and wall law
        | https://doi.org/10.1016/j.jbiomech.2011.05.041
    """
    kernels = _import_kernels()
    grid = build_grid(network, cell_length)
    state = _start(grid, start_pressure, stored_pressure)
    num_steps = _num_steps(grid, state, period, courant)
    dt = period / num_steps
    source = _interpolate(inflow[None], (np.arange(num_steps) + 0.5) / num_steps)[0]
    probes, weights = _probes(grid, sites)
    records = np.zeros((2, len(sites), num_steps))
    before, left = 0.0, 0.0
    for cycle in range(num_cycles):
        before, record = _volume(grid, state), records[cycle % 2]
        left = kernels.run_cycle(
            *(grid, state, source, dt, convection),
            bool(network.wall_viscosity.any()),
            *(probes, weights, record),
        )
        if not np.isfinite(record).all():
            raise SimulationError(
                f"The blood flow became unstable in beat {cycle + 1}: pressures are "
                f"not finite at the Courant number {courant:g}. Use a smaller one."
            )
    return Flow(
        pressure=records[(num_cycles - 1) % 2],
        previous=records[num_cycles % 2],
        volume_in=float(source.sum() * dt),
        volume_out=float(left),
        volume_change=_volume(grid, state) - before,
    )


def _import_kernels() -> Any:
    try:
        from sbi_rope.tasks.hemodynamics import kernels
    except ImportError as error:
        raise ImportError(
            "Simulating blood flow needs numba. Install it with "
            '`pip install "sbi-rope[hemodynamics]"`.'
        ) from error
    return kernels


def _start(grid: Grid, pressure: float, stored: np.ndarray) -> State:
    """Return the state of arteries at rest under a pressure."""
    num_points, num_nodes = len(grid.slope), len(grid.pivots)
    root = grid.offset + pressure / grid.slope
    zeros = {
        name: np.zeros(num_points)
        for name in (
            *("viscous", "flow", "free_flow", "velocity", "flux", "mobility"),
            *("inflow", "share", "coupling"),
        )
    }
    a, b, c = grid.quadratic.T
    return State(
        area=root**2,
        root=root,
        pressure=np.full(num_points, pressure),
        volume=a * pressure**2 + 2 * b * pressure + c,
        node_inflow=np.zeros(num_nodes),
        node_viscous=np.zeros(num_nodes),
        matrix=np.zeros((num_nodes, num_nodes)),
        leaving=np.zeros(len(grid.outlet_node)),
        stored=np.array(stored, dtype=float),
        **zeros,
    )


def _num_steps(grid: Grid, state: State, period: float, courant: float) -> int:
    """Return the number of steps a beat, from the wave velocity at the start."""
    speed = np.sqrt(grid.slope * state.root / (2 * grid.density))
    spacing = np.repeat(grid.cell_length, grid.num_cells + 1)
    return int(np.ceil(period / (courant * (spacing / speed).min())))


def _probes(grid: Grid, sites: list[Site]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points around each site, and the weight of the second one."""
    segment = np.array([site[0] for site in sites])
    cell = np.array([site[1] for site in sites]) * grid.num_cells[segment]
    index = np.minimum(cell.astype(np.int64), grid.num_cells[segment] - 1)
    point = grid.first[segment] + index
    return np.stack([point, point + 1], axis=1), cell - index


def _volume(grid: Grid, state: State) -> float:
    """Return the volume of all arteries, in m^3."""
    spacing = np.repeat(grid.cell_length, grid.num_cells + 1)
    spacing[grid.end_point] = 0.0
    return float((spacing * state.area).sum() + state.volume.sum())


def mean_stored_pressure(network: Network, pressure: float) -> np.ndarray:
    """Return the pressures of the outlets in a steady flow at a pressure, in Pa."""
    outlets = network.outlets
    share = outlets.distal_resistance / (
        outlets.proximal_resistance + outlets.distal_resistance
    )
    return outlets.pressure + share * (pressure - outlets.pressure)
