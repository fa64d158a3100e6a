r"""Flat arrays of a network of arteries that is cut into cells.

Each segment has points at the borders of its cells, numbered from ``first`` on, and
faces between them: face ``i`` lies between the points ``i`` and ``i + 1``. Points carry
areas and pressures, faces carry flows. The end points of all segments at a node share
one pressure and one volume, that of the half cells around it.
"""

from typing import Any, NamedTuple

import numpy as np

from sbi_rope.tasks.hemodynamics.network import Network

NO_PARTNER, SOURCE = -1, -2  # instead of a face
ELASTIC = 1e30  # inverse viscosity of an elastic wall: no viscous pressure results


class Grid(NamedTuple):
    r"""The arrays of a network that the kernels read.

    The tube law at a point is :math:`p = s (\sqrt A - e)`. Shapes: ``m`` segments,
    ``P`` points, ``N`` nodes, ``E = 2 m`` ends of segments, sorted by node, ``k``
    outlets.

    Attributes:
        first: First point of a segment, ``(m,)``.
        num_cells: Number of cells of a segment, ``(m,)``.
        cell_length: Length of the cells of a segment, in m, ``(m,)``.
        face_density: Inverse cell length, 0 between segments, in m^-1, ``(P,)``.
        point_density: The same around points, 0 at ends of segments, ``(P,)``.
        nodes: Nodes at the inlet and outlet of a segment, ``(m, 2)``.
        friction: Wall friction per flow, in m^2 s^-1, ``(P,)``.
        partner: Face that the momentum flux into a segment comes from, at its inlet
            and outlet, or ``NO_PARTNER`` or ``SOURCE``, ``(m, 2)``.
        slope: :math:`s = \beta / A_d`, in Pa/m, ``(P,)``.
        offset: :math:`e = \sqrt{A_d} - p_d / s`, in m, ``(P,)``.
        inverse_viscosity: :math:`A_d \Delta x / \Gamma`, with the length of the cell
            around the point, ``(P,)``.
        end_start: Where the ends at a node begin, ``(N + 1,)``.
        end_point: Point at an end of a segment, ``(E,)``.
        end_face: Face next to an end of a segment, ``(E,)``.
        end_sign: 1 where a positive flow goes into the node, -1 otherwise, ``(E,)``.
        end_half: Half the length of the cell, in m, ``(E,)``.
        end_compliance: Compliance of the half cell per root of its area, in m^2 Pa^-1,
            ``(E,)``.
        end_relaxation: Time constant of the wall :math:`2 \Gamma / \beta`, in s,
            ``(E,)``.
        quadratic: Coefficients :math:`a, b, c` of :math:`V = a p^2 + 2 b p + c`,
            ``(N, 3)``.
        pivots: Order in which nodes are eliminated, ``(N,)``.
        coupled_start: Where the nodes that a pivot is coupled with begin, ``(N + 1,)``.
        coupled: Nodes that are coupled with a pivot when it is eliminated.
        has_outlet: Whether a node is an outlet, ``(N,)``.
        outlet_node: Node of an outlet, ``(k,)``.
        outlet_law: :math:`R_1, R_2, C`, ``(3, k)``.
        outlet_pressure: Pressure behind the outlets, in Pa.
        source_node: The node that blood enters at.
        density: Density of blood, in kg m^-3.
    """

    first: np.ndarray
    num_cells: np.ndarray
    cell_length: np.ndarray
    face_density: np.ndarray
    point_density: np.ndarray
    nodes: np.ndarray
    friction: np.ndarray
    partner: np.ndarray
    slope: np.ndarray
    offset: np.ndarray
    inverse_viscosity: np.ndarray
    end_start: np.ndarray
    end_point: np.ndarray
    end_face: np.ndarray
    end_sign: np.ndarray
    end_half: np.ndarray
    end_compliance: np.ndarray
    end_relaxation: np.ndarray
    quadratic: np.ndarray
    pivots: np.ndarray
    coupled_start: np.ndarray
    coupled: np.ndarray
    has_outlet: np.ndarray
    outlet_node: np.ndarray
    outlet_law: np.ndarray
    outlet_pressure: float
    source_node: int
    density: float


class State(NamedTuple):
    """The arrays that change, of shape ``(P,)`` over points unless stated.

    Attributes:
        area: Cross-section, in m^2.
        root: Its square root.
        pressure: Elastic part of the pressure, in Pa.
        viscous: Viscous part of the pressure, in Pa.
        flow: Flow through faces, in m^3 s^-1.
        free_flow: Flow that results without viscous pressure.
        velocity: Velocity at faces, in m/s.
        flux: Momentum flux over density.
        mobility: Flow that a viscous pressure difference makes at a face.
        inflow: Net flow into the cell around a point.
        share: Viscous pressure of a point per that of the next one.
        coupling: The same per that at the inlet of its segment.
        volume: Volume of the cells around nodes, in m^3, ``(N,)``.
        node_inflow: Net flow into the cells around nodes, ``(N,)``.
        node_viscous: Viscous part of the pressure at nodes, ``(N,)``.
        matrix: Matrix of the equations for ``node_viscous``, ``(N, N)``.
        leaving: Flow through outlets, ``(k,)``.
        stored: Pressure in the compliance of outlets, in Pa, ``(k,)``.
    """

    area: np.ndarray
    root: np.ndarray
    pressure: np.ndarray
    viscous: np.ndarray
    flow: np.ndarray
    free_flow: np.ndarray
    velocity: np.ndarray
    flux: np.ndarray
    mobility: np.ndarray
    inflow: np.ndarray
    share: np.ndarray
    coupling: np.ndarray
    volume: np.ndarray
    node_inflow: np.ndarray
    node_viscous: np.ndarray
    matrix: np.ndarray
    leaving: np.ndarray
    stored: np.ndarray


def build_grid(network: Network, cell_length: float) -> Grid:
    """Cut each segment into the number of cells that is nearest to ``cell_length``."""
    num_cells = np.floor(network.length / cell_length + 0.5).astype(np.int64)
    num_cells = np.maximum(num_cells, 1)
    first = np.concatenate([[0], np.cumsum(num_cells + 1)[:-1]])
    ends = _ends(network, first, num_cells)
    pivots, coupled_start, coupled = _elimination(network)
    return Grid(
        first=first,
        num_cells=num_cells,
        cell_length=network.length / num_cells,
        nodes=np.stack([network.inlet_node, network.outlet_node], axis=1),
        partner=_partners(network, ends),
        pivots=pivots,
        coupled_start=coupled_start,
        coupled=coupled,
        source_node=network.source_node,
        density=float(network.density),
        **_at_points_and_ends(network, num_cells, ends),
        **_at_outlets(network),
    )


def _at_points_and_ends(
    network: Network, num_cells: np.ndarray, ends: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    slope, root, viscosity = _point_values(network, num_cells)
    spacing = np.repeat(network.length / num_cells, num_cells + 1)
    point, start = ends["end_point"], ends["end_start"]
    face_density, point_density, width = 1 / spacing, 1 / spacing, spacing.copy()
    face_density[np.cumsum(num_cells + 1) - 1] = 0.0
    point_density[point] = 0.0
    width[point] /= 2
    with np.errstate(divide="ignore"):
        inverse_viscosity = np.minimum(width * root**2 / viscosity, ELASTIC)
    offset = root - np.repeat(network.reference_pressure, num_cells + 1) / slope
    half = width[point]
    terms = (
        slope[point] ** -2.0,
        offset[point] / slope[point],
        offset[point] ** 2,
    )
    volume = [np.add.reduceat(half * term, start[:-1]) for term in terms]
    return {
        "face_density": face_density,
        "point_density": point_density,
        "friction": np.repeat(network.friction, num_cells + 1),
        "slope": slope,
        "offset": offset,
        "inverse_viscosity": inverse_viscosity,
        **{name: ends[name] for name in ends if name.startswith("end_")},
        "end_half": half,
        "end_compliance": 2 * half / slope[point],
        "end_relaxation": 2 * viscosity[point] / (slope[point] * root[point] ** 2),
        "quadratic": np.stack(volume, axis=1),
    }


def _at_outlets(network: Network) -> dict[str, Any]:
    outlets = network.outlets
    node = network.outlet_node[outlets.segment]
    r1, r2 = outlets.proximal_resistance, outlets.distal_resistance
    return {
        "has_outlet": np.isin(np.arange(network.num_nodes), node),
        "outlet_node": node,
        "outlet_law": np.stack([r1, r2, outlets.compliance]),
        "outlet_pressure": float(outlets.pressure),
    }


def _point_values(
    network: Network, num_cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return tube law, root of the area and viscosity at all points."""
    slope, root, viscosity = [], [], []
    for segment, num in enumerate(num_cells):
        radius = network.radius(segment, np.linspace(0.0, 1.0, num + 1))
        slope.append(network.tube_law(segment, radius))
        root.append(np.sqrt(np.pi) * radius)
        viscosity.append(network.viscosity(segment, radius))
    return np.concatenate(slope), np.concatenate(root), np.concatenate(viscosity)


def _ends(
    network: Network, first: np.ndarray, num_cells: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the ends of all segments, sorted by node."""
    node = np.concatenate([network.inlet_node, network.outlet_node])
    order = np.argsort(node, kind="stable")
    segment = np.tile(np.arange(len(first)), 2)[order]
    is_outlet = order >= len(first)
    last = first + num_cells
    return {
        "node": node[order],
        "segment": segment,
        "side": is_outlet.astype(np.int64),
        "end_start": np.searchsorted(node[order], np.arange(network.num_nodes + 1)),
        "end_point": np.where(is_outlet, last[segment], first[segment]),
        "end_face": np.where(is_outlet, last[segment] - 1, first[segment]),
        "end_sign": np.where(is_outlet, 1.0, -1.0),
    }


def _partners(network: Network, ends: dict[str, np.ndarray]) -> np.ndarray:
    """Return where the momentum that flows into a segment comes from.

    At a joint of two segments it is the momentum that leaves the other one. At a
    branching there is no one-dimensional answer: the flux is taken to be constant
    there, so that the static pressure is shared.
    """
    partner = np.full((len(network.length), 2), NO_PARTNER)
    start = ends["end_start"]
    for node in range(network.num_nodes):
        at_node = range(start[node], start[node + 1])
        for i in at_node:
            slot = ends["segment"][i], ends["side"][i]
            if len(at_node) == 1 and node == network.source_node:
                partner[slot] = SOURCE
            elif len(at_node) == 2:
                other = at_node[0] if i == at_node[1] else at_node[1]
                partner[slot] = ends["end_face"][other]
    return partner


def _elimination(network: Network) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an order of the nodes that keeps their system of equations sparse.

    Nodes with the fewest neighbours go first; what is left are the few that loops
    couple with each other.
    """
    neighbours: list[set[int]] = [set() for _ in range(network.num_nodes)]
    for a, b in zip(network.inlet_node, network.outlet_node, strict=True):
        neighbours[a].add(int(b))
        neighbours[b].add(int(a))
    left = set(range(network.num_nodes))
    pivots, coupled = [], []
    while left:
        pivot = min(left, key=lambda node: (len(neighbours[node]), node))
        around = sorted(neighbours[pivot])
        for node in around:
            neighbours[node] |= set(around)
            neighbours[node] -= {node, pivot}
        left.remove(pivot)
        pivots.append(pivot)
        coupled.append(around)
    start = np.concatenate([[0], np.cumsum([len(around) for around in coupled])])
    flat = [node for around in coupled for node in around]
    return np.array(pivots), start.astype(np.int64), np.array(flat, dtype=np.int64)
