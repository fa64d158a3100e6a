r"""Exact small waves in a network, by harmonics and without a grid in time.

An independent solution that the solver is compared with.
"""

import numpy as np

from sbi_rope.tasks.hemodynamics.network import Network

__all__ = ["linear_pressure"]

PIECE_LENGTH = 2e-3  # m, of the cylinders that a tapered segment is made of

# Transmission matrix of a tube: (p, Q) at its inlet from those at its outlet, as the
# entries a, b, c, d, each of shape (h,) over harmonics.
Transmission = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def linear_pressure(
    network: Network,
    inflow: np.ndarray,
    period: float,
    *,
    pressure: float,
    sites: list[tuple[int, float]],
    num_harmonics: int,
) -> np.ndarray:
    r"""Return pressure waves around a state of rest.

    In a cylinder the equations of blood flow, linearised around rest at a uniform
    pressure, are those of an electric line with, per length,

    .. math:: Z = \frac{\rho}{A} \left(i \omega + \frac{f}{A}\right), \qquad
        Y = \frac{i \omega C}{1 + i \omega \tau}, \qquad
        C = \frac{2 \sqrt A}{\beta / A_d}, \quad \tau = \frac{2 \Gamma}{\beta}

    Pressures at nodes follow from the balance of flows: inflow, Windkessels and the
    admittances of all segments.

    Args:
        network: The arteries.
        inflow: Flow into the source node over a beat, equally spaced, in m^3 s^-1; its
            mean does not matter.
        period: Length of a beat, in s.
        pressure: The pressure at rest, in Pa.
        sites: Segment, counted from 0, and position along it from 0 to 1.
        num_harmonics: How many harmonics of the inflow are used.

    Returns:
        Deviation of the pressure from the one at rest, at the times of the inflow, in
        Pa, shape ``(r, n)``.
    """
    spectrum = np.fft.rfft(inflow)[1 : num_harmonics + 1]
    omega = 2 * np.pi / period * np.arange(1, len(spectrum) + 1)
    num_segments = len(network.length)
    lines = [
        _transmission(network, k, 0.0, 1.0, omega, pressure)
        for k in range(num_segments)
    ]
    nodal = _node_pressures(network, lines, spectrum, omega)
    waves = []
    for segment, position in sites:
        inlet = nodal[:, network.inlet_node[segment]]
        outlet = nodal[:, network.outlet_node[segment]]
        a, b, c, d = lines[segment]
        flow_out = (inlet - a * outlet) / b
        flow_in = c * outlet + d * flow_out
        _, b, _, d = _transmission(network, segment, 0.0, position, omega, pressure)
        coefficients = np.zeros(len(inflow) // 2 + 1, dtype=complex)
        coefficients[1 : len(spectrum) + 1] = d * inlet - b * flow_in
        waves.append(np.fft.irfft(coefficients, len(inflow)))
    return np.stack(waves)


def _node_pressures(
    network: Network,
    lines: list[Transmission],
    spectrum: np.ndarray,
    omega: np.ndarray,
) -> np.ndarray:
    """Return the harmonics of the pressure at all nodes, shape (h, nodes)."""
    num_nodes, outlets = network.num_nodes, network.outlets
    admittance = np.zeros((len(omega), num_nodes, num_nodes), dtype=complex)
    for k, (a, b, c, d) in enumerate(lines):
        i, j = network.inlet_node[k], network.outlet_node[k]
        admittance[:, i, i] += d / b
        admittance[:, i, j] += c - d * a / b
        admittance[:, j, i] -= 1 / b
        admittance[:, j, j] += a / b
    for n, segment in enumerate(outlets.segment):
        distal = outlets.distal_resistance[n]
        behind = distal / (1 + 1j * omega * distal * outlets.compliance[n])
        node = network.outlet_node[segment]
        admittance[:, node, node] += 1 / (outlets.proximal_resistance[n] + behind)
    source = np.zeros((len(omega), num_nodes, 1), dtype=complex)
    source[:, network.source_node, 0] = spectrum
    return np.linalg.solve(admittance, source)[:, :, 0]


def _transmission(
    network: Network,
    segment: int,
    start: float,
    stop: float,
    omega: np.ndarray,
    pressure: float,
) -> Transmission:
    """Return the matrix of a part of a segment, as a chain of short cylinders."""
    length = (stop - start) * network.length[segment]
    num = max(int(np.ceil(length / PIECE_LENGTH)), 1)
    radii = network.radius(
        segment, start + (stop - start) * (np.arange(num) + 0.5) / num
    )
    total = np.broadcast_to(np.eye(2, dtype=complex), (len(omega), 2, 2))
    for radius in radii:
        slope = network.tube_law(segment, radius)
        reference = network.reference_pressure[segment]
        root = np.sqrt(np.pi) * radius + (pressure - reference) / slope
        compliance = 2 * root / slope
        relaxation = 2 * network.viscosity(segment, radius) / slope
        relaxation /= np.pi * radius**2
        friction = network.friction[segment] / root**2
        series = network.density / root**2 * (1j * omega + friction)
        shunt = 1j * omega * compliance / (1 + 1j * omega * relaxation)
        impedance = np.sqrt(series / shunt)
        phase = np.sqrt(series * shunt) * length / num
        piece = np.empty((len(omega), 2, 2), dtype=complex)
        piece[:, 0, 0] = piece[:, 1, 1] = np.cosh(phase)
        piece[:, 0, 1] = impedance * np.sinh(phase)
        piece[:, 1, 0] = np.sinh(phase) / impedance
        total = total @ piece
    return total[:, 0, 0], total[:, 0, 1], total[:, 1, 0], total[:, 1, 1]
