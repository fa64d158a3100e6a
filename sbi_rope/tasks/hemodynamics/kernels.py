r"""The compiled loops of the solver.

A step takes flows from :math:`t - \Delta t / 2` to :math:`t + \Delta t / 2`, then areas
and pressures from :math:`t` to :math:`t + \Delta t`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from sbi_rope.tasks.hemodynamics.grid import SOURCE, Grid, State

# Weight of the new flow in the viscous pressure: 1/2 is of second order, but lets the
# shortest waves ring.
IMPLICIT = 0.55
OLD = (1 - IMPLICIT) / IMPLICIT  # that of the old flow, relative to it


def _compiled(function: Callable[..., Any]) -> Any:
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to keep compiled code in can be written to
        return njit(**options)(function)


@_compiled
def run_cycle(
    grid: Grid,
    state: State,
    source: np.ndarray,
    dt: float,
    convection: float,
    viscoelastic: bool,  # noqa: FBT001
    probes: np.ndarray,
    weights: np.ndarray,
    record: np.ndarray,
) -> float:
    """Simulate one beat in place, and return the volume that left, in m^3.

    ``source`` is the inflow at the middle of each step, ``probes`` are points left and
    right of where the pressure is recorded at the start of each step, ``weights``
    those of the right ones. All but ``state`` and ``record`` are left as they are.
    """
    left = 0.0
    for step in range(len(source)):
        _momentum(grid, state, dt, convection, source[step - 1])
        if viscoelastic:
            _damp(grid, state, dt, source[step])
        else:
            state.flow[:] = state.free_flow
        for i in range(len(probes)):
            a, b = probes[i, 0], probes[i, 1]
            left_value = state.pressure[a] + state.viscous[a]
            right_value = state.pressure[b] + state.viscous[b]
            record[i, step] = left_value + weights[i] * (right_value - left_value)
        _continuity(grid, state, dt)
        _nodes(grid, state, dt, source[step])
        left += dt * state.leaving.sum()
    return left


@_compiled
def _momentum(
    grid: Grid, state: State, dt: float, convection: float, source: float
) -> None:
    # Over all points: the faces between segments have no inverse length, and no flow.
    area, pressure, flow = state.area, state.pressure, state.flow
    velocity, flux = state.velocity, state.flux
    num_faces = len(area) - 1
    for i in range(num_faces):
        velocity[i] = 2 * flow[i] / (area[i] + area[i + 1])
    for i in range(1, num_faces):
        middle = 0.5 * convection * (flow[i - 1] + flow[i])
        flux[i] = max(middle, 0.0) * velocity[i - 1] + min(middle, 0.0) * velocity[i]
    _fluxes_at_ends(grid, state, convection, source)
    push = 0.5 * dt / grid.density
    for i in range(num_faces):
        both = area[i] + area[i + 1]
        damping = both / (both + 2 * dt * grid.friction[i])
        mobility = push * both * grid.face_density[i]
        step = dt * grid.face_density[i] * (flux[i] - flux[i + 1])
        step += mobility * (pressure[i] - pressure[i + 1])
        state.free_flow[i] = damping * (flow[i] + step)
        state.mobility[i] = damping * mobility


@_compiled
def _fluxes_at_ends(grid: Grid, state: State, convection: float, source: float) -> None:
    flow, velocity, partner = state.flow, state.velocity, grid.partner
    for k in range(len(grid.first)):
        start, end = grid.first[k], grid.first[k] + grid.num_cells[k]
        comes = flow[start] > 0 and partner[k, 0] >= 0
        donor = partner[k, 0] if comes else start
        state.flux[start] = convection * flow[donor] * velocity[donor]
        if flow[start] > 0 and partner[k, 0] == SOURCE:
            state.flux[start] = convection * source**2 / state.area[start]
        comes = flow[end - 1] < 0 and partner[k, 1] >= 0
        donor = partner[k, 1] if comes else end - 1
        state.flux[end] = convection * flow[donor] * velocity[donor]


@_compiled
def _damp(grid: Grid, state: State, dt: float, source: float) -> None:
    r"""Find the flow that agrees with the viscous pressure that it makes itself.

    .. math:: Q = Q^* - w \Delta p_v, \qquad
        p_v = G (\theta \Delta Q + (1 - \theta) \Delta Q_{old})

    is a symmetric system for :math:`p_v` over the whole network. Points within
    segments are eliminated first, which leaves one for the nodes.
    """
    _assemble_nodes(grid, state, dt, source)
    # Of each point within a segment: the diagonal, and the right side.
    for i in range(1, len(state.area)):
        own = grid.inverse_viscosity[i] * state.root[i] / IMPLICIT
        state.share[i] = own + state.mobility[i - 1] + state.mobility[i]
        value = state.free_flow[i - 1] - state.free_flow[i]
        state.viscous[i] = value + OLD * state.inflow[i]
    for k in range(len(grid.first)):
        _eliminate_segment(grid, state, k)
    _solve_nodes(grid, state)
    for k in range(len(grid.first)):
        _substitute_segment(grid, state, k)
    for i in range(len(state.flow) - 1):
        drop = state.viscous[i + 1] - state.viscous[i]
        state.flow[i] = state.free_flow[i] - state.mobility[i] * drop


@_compiled
def _assemble_nodes(grid: Grid, state: State, dt: float, source: float) -> None:
    matrix, right = state.matrix, state.node_viscous
    for i in range(len(grid.pivots)):
        node = grid.pivots[i]
        for j in range(grid.coupled_start[i], grid.coupled_start[i + 1]):
            matrix[node, grid.coupled[j]] = 0.0
            matrix[grid.coupled[j], node] = 0.0
        compliance, viscosity = 0.0, 1e-30
        right[node] = OLD * state.node_inflow[node]
        for j in range(grid.end_start[node], grid.end_start[node + 1]):
            point = grid.end_point[j]
            # The half cells relax together, with the mean of their time constants.
            part = grid.end_compliance[j] * state.root[point]
            compliance += part
            viscosity += part * grid.end_relaxation[j]
            right[node] += grid.end_sign[j] * state.free_flow[grid.end_face[j]]
        matrix[node, node] = compliance**2 / (IMPLICIT * viscosity)
        if node == grid.source_node:
            right[node] += source
    for i in range(len(grid.outlet_node)):
        _assemble_outlet(grid, state, dt, i)


@_compiled
def _assemble_outlet(grid: Grid, state: State, dt: float, i: int) -> None:
    """Let the flow out of an outlet depend on the viscous pressure, linearly.

    The flow of the step before would add an inertia that finer grids do not remove.
    """
    node = grid.outlet_node[i]
    end = grid.end_start[node]
    point = grid.end_point[end]
    known, _, conductance = _windkessel(grid, state, dt, i)
    root, half = state.root[point], grid.end_half[end]
    viscosity = 1 / (grid.inverse_viscosity[point] * root)
    stiffness = grid.slope[point] / (2 * root * half)
    # Net inflow = (inflow - conductance (pressure - known)) / retention.
    retention = 1 + conductance * (viscosity + dt * stiffness / 2)
    state.matrix[node, node] *= retention
    state.node_viscous[node] += OLD * (retention - 1) * state.node_inflow[node]
    state.node_viscous[node] -= conductance * (state.pressure[point] - known)


@_compiled
def _windkessel(
    grid: Grid, state: State, dt: float, i: int
) -> tuple[float, float, float]:
    """Return mean stored pressure without flow, its response to flow, conductance."""
    r1, compliance = grid.outlet_law[0, i], grid.outlet_law[2, i]
    decay = dt / (2 * compliance * grid.outlet_law[1, i])
    known = (state.stored[i] + decay * grid.outlet_pressure) / (1 + decay)
    response = dt / (2 * compliance * (1 + decay))
    return known, response, 1 / (r1 + response)


@_compiled
def _eliminate_segment(grid: Grid, state: State, k: int) -> None:
    r"""Express each point by the next one and the inlet of the segment.

    .. math:: p_i = r_i + s_i p_{i + 1} + c_i p_{inlet}
    """
    start, end = grid.first[k], grid.first[k] + grid.num_cells[k]
    mobility = state.mobility
    at_inlet, inlet_right = mobility[start], 0.0
    taken, carried, link = 0.0, 0.0, mobility[start]
    for i in range(start + 1, end):
        inverse = 1.0 / (state.share[i] - taken)
        share = mobility[i] * inverse
        value = state.viscous[i] + carried
        state.share[i] = share
        state.viscous[i] = inverse * value
        state.coupling[i] = inverse * link
        inlet_right += link * state.viscous[i]
        at_inlet -= link * state.coupling[i]
        carried = share * value
        taken = mobility[i] * share
        link *= share
    inlet, outlet = grid.nodes[k, 0], grid.nodes[k, 1]
    state.matrix[inlet, inlet] += at_inlet
    state.matrix[outlet, outlet] += mobility[end - 1] - taken
    state.matrix[inlet, outlet] -= link
    state.matrix[outlet, inlet] -= link
    state.node_viscous[inlet] += inlet_right
    state.node_viscous[outlet] += carried


@_compiled
def _solve_nodes(grid: Grid, state: State) -> None:
    matrix, right = state.matrix, state.node_viscous
    for i in range(len(grid.pivots)):
        node = grid.pivots[i]
        start, end = grid.coupled_start[i], grid.coupled_start[i + 1]
        inverse = 1.0 / matrix[node, node]
        for j in range(start, end):
            a = grid.coupled[j]
            factor = matrix[node, a] * inverse
            right[a] -= factor * right[node]
            for n in range(start, end):
                matrix[a, grid.coupled[n]] -= factor * matrix[node, grid.coupled[n]]
    for i in range(len(grid.pivots) - 1, -1, -1):
        node = grid.pivots[i]
        value = right[node]
        for j in range(grid.coupled_start[i], grid.coupled_start[i + 1]):
            value -= matrix[node, grid.coupled[j]] * right[grid.coupled[j]]
        right[node] = value / matrix[node, node]


@_compiled
def _substitute_segment(grid: Grid, state: State, k: int) -> None:
    start, end = grid.first[k], grid.first[k] + grid.num_cells[k]
    viscous = state.viscous
    at_inlet = state.node_viscous[grid.nodes[k, 0]]
    after = state.node_viscous[grid.nodes[k, 1]]
    viscous[start], viscous[end] = at_inlet, after
    for i in range(end - 1, start, -1):
        after = viscous[i] + state.coupling[i] * at_inlet + state.share[i] * after
        viscous[i] = after


@_compiled
def _continuity(grid: Grid, state: State, dt: float) -> None:
    # Over all points: those at the ends have no inverse length, and so keep their area.
    for i in range(1, len(state.area)):
        state.inflow[i] = state.flow[i - 1] - state.flow[i]
        state.area[i] += dt * grid.point_density[i] * state.inflow[i]
        state.root[i] = np.sqrt(state.area[i])
        state.pressure[i] = grid.slope[i] * (state.root[i] - grid.offset[i])


@_compiled
def _nodes(grid: Grid, state: State, dt: float, source: float) -> None:
    for node in range(len(state.volume)):
        inflow = source if node == grid.source_node else 0.0
        for j in range(grid.end_start[node], grid.end_start[node + 1]):
            inflow += grid.end_sign[j] * state.flow[grid.end_face[j]]
        state.node_inflow[node] = inflow
        if grid.has_outlet[node]:
            continue
        state.volume[node] += dt * inflow
        a, b = grid.quadratic[node, 0], grid.quadratic[node, 1]
        missing = grid.quadratic[node, 2] - state.volume[node]
        pressure = (np.sqrt(b * b - a * missing) - b) / a
        for j in range(grid.end_start[node], grid.end_start[node + 1]):
            point = grid.end_point[j]
            state.pressure[point] = pressure
            state.root[point] = grid.offset[point] + pressure / grid.slope[point]
            state.area[point] = state.root[point] ** 2
    for i in range(len(state.leaving)):
        _outlet(grid, state, dt, i)


@_compiled
def _outlet(grid: Grid, state: State, dt: float, i: int) -> None:
    """Advance a Windkessel and the half cell before it by the trapezoidal rule."""
    node = grid.outlet_node[i]
    end = grid.end_start[node]
    point, half = grid.end_point[end], grid.end_half[end]
    slope, offset = grid.slope[point], grid.offset[point]
    known, response, conductance = _windkessel(grid, state, dt, i)
    damping = conductance / (grid.inverse_viscosity[point] * state.root[point])
    volume, inflow = state.volume[node], state.node_inflow[node]
    # A quadratic equation for the new root of the area.
    square = half * (1 + damping)
    linear = dt * slope * conductance / 2
    rest = (state.pressure[point] - slope * offset) / 2 - known
    constant = volume * (1 + damping) + dt * (inflow - conductance * rest)
    root = (np.sqrt(linear**2 + 4 * square * constant) - linear) / (2 * square)
    state.root[point], state.area[point] = root, root**2
    state.pressure[point] = slope * (root - offset)
    state.volume[node] = half * root**2
    state.node_inflow[node] = (state.volume[node] - volume) / dt
    state.leaving[i] = inflow - state.node_inflow[node]
    state.stored[i] = 2 * (known + response * state.leaving[i]) - state.stored[i]
