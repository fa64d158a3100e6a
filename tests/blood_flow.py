r"""Blood flow by other means: small waves by harmonics, and what openBF found.

References:
    | openBF: Julia software for 1D blood flow modelling (Melis, 2018)
    | https://github.com/INSIGNEO/openBF, commit 0376f4dc (Apache-2.0)
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from sbi_rope.tasks.hemodynamics.network import Network, Outlets
from sbi_rope.tasks.hemodynamics.solver import Flow, solve
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Subject

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
REST = 1e4  # Pa, of the networks of equal walls below
PIECE_LENGTH = 2e-3  # m, of the cylinders that a tapered segment is made of
NUM_HARMONICS = 60


def make_network(
    nodes: list[tuple[int, int]],
    *,
    length: list[float],
    radius: list[tuple[float, float]],
    outlets: list[int],
    viscosity: float = 0.0,
    friction: float = 0.0,
    resistance: tuple[float, float] = (1e8, 1e9),
) -> Network:
    """Return tubes between nodes, all with the same walls and outlets."""
    num = len(nodes)
    inlet_node, outlet_node = np.array(nodes).T
    inlet_radius, outlet_radius = np.array(radius).T
    return Network(
        inlet_node=inlet_node,
        outlet_node=outlet_node,
        length=np.array(length),
        inlet_radius=inlet_radius,
        outlet_radius=outlet_radius,
        stiffness=np.array([[0.0] * num, [0.0] * num, [6e4] * num]),
        wall_viscosity=np.array([[viscosity] * num, [0.0] * num]),
        reference_pressure=np.full(num, REST),
        friction=np.full(num, friction),
        density=1060.0,
        source_node=0,
        outlets=Outlets(
            segment=np.array(outlets),
            proximal_resistance=np.full(len(outlets), resistance[0]),
            distal_resistance=np.full(len(outlets), resistance[1]),
            compliance=np.full(len(outlets), 1e-9),
            pressure=REST,
        ),
    )


def run(
    network: Network,
    inflow: np.ndarray,
    period: float,
    *,
    pressure: float = REST,
    **changes: Any,
) -> Flow:
    """Solve with usual settings, from a network that is at rest at a pressure."""
    options: dict[str, Any] = {
        "sites": [(0, 0.5)],
        "start_pressure": pressure,
        "stored_pressure": np.full(len(network.outlets.segment), pressure),
        "cell_length": 0.01,
        "courant": 0.6,
        "num_cycles": 3,
        "convection": 4 / 3,
    }
    return solve(network, inflow, period, **(options | changes))


def small_wave_error(
    network: Network,
    inflow: np.ndarray,
    period: float,
    *,
    pressure: float,
    sites: list[tuple[int, float]],
    **changes: Any,
) -> float:
    r"""Return the difference from the exact small waves, as a share of their rms.

    It is the largest over the sites. In a cylinder the equations of blood flow,
    linearised around rest at a uniform pressure, are those of an electric line with,
    per length,

    .. math:: Z = \frac{\rho}{A} \left(i \omega + \frac{f}{A}\right), \qquad
        Y = \frac{i \omega C}{1 + i \omega \tau}, \qquad
        C = \frac{2 \sqrt A}{\beta / A_d}, \quad \tau = \frac{2 \Gamma}{\beta}

    Pressures at nodes follow from the balance of flows: inflow, Windkessels and the
    admittances of all segments. The inflow must be small.
    """
    changes |= {"pressure": pressure, "sites": sites, "convection": 0.0}
    inflow = inflow - inflow.mean()
    flow = run(network, inflow, period, **changes)
    waves = flow.at(np.arange(len(inflow)) / len(inflow))
    spectrum = np.fft.rfft(inflow)[1 : NUM_HARMONICS + 1]
    omega = 2 * np.pi / period * np.arange(1, NUM_HARMONICS + 1)
    num_nodes, outlets = network.num_nodes, network.outlets
    admittance = np.zeros((NUM_HARMONICS, num_nodes, num_nodes), dtype=complex)
    ends = list(zip(network.inlet_node, network.outlet_node, strict=True))
    lines = [_transmission(network, k, 1.0, omega, pressure) for k in range(len(ends))]
    for (i, j), ((a, b), (c, d)) in zip(ends, lines, strict=True):
        admittance[:, i, i] += d / b
        admittance[:, i, j] += c - d * a / b
        admittance[:, j, i] -= 1 / b
        admittance[:, j, j] += a / b
    for n, segment in enumerate(outlets.segment):
        distal = outlets.distal_resistance[n]
        behind = distal / (1 + 1j * omega * distal * outlets.compliance[n])
        node = network.outlet_node[segment]
        admittance[:, node, node] += 1 / (outlets.proximal_resistance[n] + behind)
    source = np.zeros((NUM_HARMONICS, num_nodes, 1), dtype=complex)
    source[:, network.source_node, 0] = spectrum
    nodal = np.linalg.solve(admittance, source)[:, :, 0]
    exact = []
    for segment, position in sites:
        inlet, outlet = (nodal[:, node] for node in ends[segment])
        (a, b), (c, d) = lines[segment]
        flow_in = c * outlet + d * (inlet - a * outlet) / b
        (_, b), (_, d) = _transmission(network, segment, position, omega, pressure)
        coefficients = np.zeros(len(inflow) // 2 + 1, dtype=complex)
        coefficients[1 : NUM_HARMONICS + 1] = d * inlet - b * flow_in
        exact.append(np.fft.irfft(coefficients, len(inflow)))
    return float(((waves - exact).std(axis=1) / np.std(exact, axis=1)).max())


def _transmission(
    network: Network, segment: int, stop: float, omega: np.ndarray, pressure: float
) -> np.ndarray:
    """Return the matrix, (2, 2, h), of a segment up to a place.

    It makes pressure and flow at the inlet from those at the place, by a chain of short
    cylinders.
    """
    length = stop * network.length[segment]
    num = max(int(np.ceil(length / PIECE_LENGTH)), 1)
    total = np.broadcast_to(np.eye(2, dtype=complex), (len(omega), 2, 2))
    for radius in network.radius(segment, stop * (np.arange(num) + 0.5) / num):
        slope = network.tube_law(segment, radius)
        reference = network.reference_pressure[segment]
        root = np.sqrt(np.pi) * radius + (pressure - reference) / slope
        relaxation = 2 * network.viscosity(segment, radius) / slope
        relaxation /= np.pi * radius**2
        friction = network.friction[segment] / root**2
        series = network.density / root**2 * (1j * omega + friction)
        shunt = 1j * omega * 2 * root / slope / (1 + 1j * omega * relaxation)
        impedance = np.sqrt(series / shunt)
        phase = np.sqrt(series * shunt) * length / num
        cosh, sinh = np.cosh(phase), np.sinh(phase)
        piece = np.array([[cosh, impedance * sinh], [sinh / impedance, cosh]])
        total = total @ np.moveaxis(piece, 2, 0)
    return np.moveaxis(total, 0, 2)


# openBF ------------------------------------------------------------------------------


def openbf_error(folder: Path, case: str, *, cell_length: float = 0.01) -> float:
    """Return the difference from openBF, in % of the mean pressure.

    It is the root mean square over the last beat in the middle of a vessel, averaged
    over vessels. Both start from an empty network and simulate as many beats. The case
    is ``"cca"``, ``"ibif"`` or ``"adan56"``.
    """
    text = (folder / f"{case}.yaml").read_text()
    inflow_time, inflow = np.loadtxt(folder / f"{case}_inlet.dat").T
    vessels = [
        dict(re.findall(r"(\w+):\s*(\S+)", entry))
        for entry in re.split(r"^\s*-\s", text.split("network:")[1], flags=re.M)[1:]
    ]
    with np.load(folder / f"ref_{case}.npz") as reference:
        waves = [reference[f"{vessel['label']}__P"] for vessel in vessels]
    period = inflow_time[-1]
    num_cycles = round(waves[0][-1, 0] / period)
    network = openbf_network(vessels, text)
    flow = run(
        network,
        np.interp(np.arange(2000) / 2000 * period, inflow_time, inflow),
        period,
        sites=[(segment, 0.5) for segment in range(len(vessels))],
        pressure=float(network.reference_pressure[0]),
        stored_pressure=np.zeros(len(network.outlets.segment)),
        cell_length=cell_length,
        num_cycles=num_cycles,
        convection=1.0,
    )
    expected = np.stack([wave[:, 3] for wave in waves])
    found = flow.at(waves[0][:, 0] / period - (num_cycles - 1))
    error = np.sqrt(((found - expected) ** 2).mean(axis=1))
    return float(100 * (error / expected.mean(axis=1)).mean())


def openbf_network(vessels: list[dict[str, str]], text: str) -> Network:
    r"""Return the network of a case.

    Walls follow :math:`p = p_{ext} + \beta (\sqrt{A / A_0} - 1)` with :math:`\beta =
    \sqrt{\pi / A_0} h_0 E / (1 - 0.5^2)`, which is the tube law of
    :class:`Network`. The taper of version 2 of openBF multiplies by the length of a
    cell twice and so has no effect: vessels are cylinders of their proximal radius.
    """

    def column(key: str, default: float = 0.0) -> np.ndarray:
        return np.array([float(vessel.get(key, default)) for vessel in vessels])

    blood = dict(re.findall(r"^\s+(rho|mu):\s*(\S+)", text, flags=re.M))
    density, viscosity = float(blood["rho"]), float(blood["mu"])
    radius = np.array([float(v.get("Rp", v.get("R0", "nan"))) for v in vessels])
    # Thickness of walls that have none.
    usual = 0.2802 * np.exp(-505.3 * radius) + 0.1324 * np.exp(-11.14 * radius)
    thickness = np.where(column("h0") > 0, column("h0"), radius * usual)
    # beta of the tube law is 4/3 sqrt(pi) E h: the factor is in 1 / (1 - 0.5^2).
    stiffness = column("E") * thickness
    zeros = np.zeros(len(vessels))
    source = set(column("sn").astype(int)) - set(column("tn").astype(int))
    segment = np.flatnonzero(column("Cc") > 0)
    return Network(
        inlet_node=column("sn").astype(int) - 1,
        outlet_node=column("tn").astype(int) - 1,
        length=column("L"),
        inlet_radius=radius,
        outlet_radius=radius,
        stiffness=np.stack([zeros, zeros, stiffness / radius]),
        wall_viscosity=np.stack([zeros, zeros]),
        reference_pressure=column("Pext"),
        friction=2 * (column("gamma_profile", 2) + 2) * np.pi * viscosity / density,
        density=density,
        source_node=source.pop() - 1,
        outlets=Outlets(
            segment=segment,
            proximal_resistance=column("R1")[segment],
            distal_resistance=column("R2")[segment],
            compliance=column("Cc")[segment],
            pressure=0.0,
        ),
    )
