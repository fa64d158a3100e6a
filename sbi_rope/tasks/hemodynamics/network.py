r"""Networks of elastic tubes that end in the microvasculature."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from sbi_rope.tasks.hemodynamics import arteries
from sbi_rope.tasks.hemodynamics.arteries import MMHG
from sbi_rope.tasks.hemodynamics.subject import Physics, Subject
from sbi_rope.utils.errors import SimulationError

ML = 1e-6  # m^3
# Range that the stiffness k3 of large arteries is sought in, kg s^-2 m^-1. The wave
# velocity grows with its root, from 2 to 60 m/s.
STIFFNESS_RANGE = (5e2, 5e6)
PATHS = (arteries.CAROTID_PATH, arteries.FEMORAL_PATH)
MAX_PROXIMAL = 0.9  # part of an outlet's resistance


@dataclass(frozen=True, kw_only=True)
class Outlets:
    r"""Three-element Windkessels in which segments end, for the microvasculature.

    .. math:: Q = (p - p_c) / R_1, \qquad
        C \dot p_c = Q - (p_c - p_{out}) / R_2

    Attributes:
        segment: Segments that end here, counted from 0, shape ``(k,)``.
        proximal_resistance: :math:`R_1`, in Pa s m^-3, shape ``(k,)``.
        distal_resistance: :math:`R_2`, in Pa s m^-3, shape ``(k,)``.
        compliance: :math:`C`, in m^3 Pa^-1, shape ``(k,)``.
        pressure: :math:`p_{out}`, in Pa.
    """

    segment: np.ndarray
    proximal_resistance: np.ndarray
    distal_resistance: np.ndarray
    compliance: np.ndarray
    pressure: float


@dataclass(frozen=True, kw_only=True)
class Network:
    r"""Tapered tubes between nodes, with the physics of walls and blood.

    At the radius :math:`R` a wall has the stiffness and viscosity

    .. math:: Eh = R (k_1 e^{k_2 R} + k_3), \qquad \Gamma = b_0 + b_1 / (2 R)

    and there is the pressure :math:`p = p_d + \frac{\beta}{A_d}(\sqrt A - \sqrt{A_d})
    + \frac{\Gamma}{A_d \sqrt A} \partial_t A` with :math:`\beta = \frac43 \sqrt\pi Eh`
    and :math:`A_d = \pi R^2`. Units are SI, shapes ``(m,)`` over segments.

    Attributes:
        inlet_node: Node at the inlet of a segment, counted from 0.
        outlet_node: Node at its outlet.
        length: In m.
        inlet_radius: Radius at the reference pressure, in m, linear in between.
        outlet_radius: Radius at the other end, in m.
        stiffness: :math:`k_1, k_2, k_3`, shape ``(3, m)``.
        wall_viscosity: :math:`b_0, b_1`, shape ``(2, m)``, and 0 for elastic walls.
        reference_pressure: :math:`p_d`, in Pa.
        friction: Wall friction per flow, :math:`2 (\zeta + 2) \pi \mu / \rho`, in
            m^2 s^-1.
        density: Of blood, in kg m^-3.
        source_node: The node that blood enters at.
        outlets: Where it leaves.
    """

    inlet_node: np.ndarray
    outlet_node: np.ndarray
    length: np.ndarray
    inlet_radius: np.ndarray
    outlet_radius: np.ndarray
    stiffness: np.ndarray
    wall_viscosity: np.ndarray
    reference_pressure: np.ndarray
    friction: np.ndarray
    density: float
    source_node: int
    outlets: Outlets

    @property
    def num_nodes(self) -> int:
        """Number of nodes, those at the ends included."""
        return int(max(self.inlet_node.max(), self.outlet_node.max())) + 1

    def radius(self, segment: int, position: np.ndarray) -> np.ndarray:
        """Return the reference radius at positions from 0 to 1 of a segment, in m."""
        inlet, outlet = self.inlet_radius[segment], self.outlet_radius[segment]
        return inlet + (outlet - inlet) * position

    def tube_law(self, segment: int, radius: np.ndarray) -> np.ndarray:
        r"""Return :math:`\beta / A_d` at reference radii of a segment, in Pa/m."""
        stiffness = _stiffness(radius, *self.stiffness[:, segment])
        return 4 / 3 * np.sqrt(np.pi) * stiffness / (np.pi * radius**2)

    def viscosity(self, segment: int, radius: np.ndarray) -> np.ndarray:
        r"""Return :math:`\Gamma` at reference radii of a segment, in kg/s."""
        constant, slope = self.wall_viscosity[:, segment]
        return constant + slope / (2 * radius)


def build_network(subject: Subject, physics: Physics) -> Network:
    r"""Return the arteries of a subject.

    Large arteries get the subject's diameters, all walls the stiffness :math:`k_3`
    that the wave velocity between carotid and femoral artery follows from. The
    resistances of the beds are scaled so that all of them together are

    .. math:: R = (\bar p - p_{out}) / (SV \cdot HR).

    Raises:
        SimulationError: If no stiffness gives the subject's wave velocity.
    """
    columns = arteries.SEGMENTS
    inlet_node, outlet_node = columns[:2].astype(int) - 1
    table_length = 1e-3 * columns[2]
    length = table_length * np.array(subject.length_factors)
    length = np.maximum(length, physics.min_segment_length)
    inlet, outlet = _radii(1e-3 * columns[3], 1e-3 * columns[4], subject)
    k3 = _solve_stiffness(length, inlet, outlet, subject)
    ones = np.ones_like(length)
    # Which walls are viscous is a matter of the table: a stretched segment stays so.
    viscous = physics.viscoelastic * (table_length > arteries.MIN_VISCOUS_LENGTH)
    b0, b1 = arteries.WALL_VISCOSITY, arteries.WALL_VISCOSITY_SLOPE
    friction = 2 * (arteries.PROFILE_EXPONENT + 2) * np.pi * arteries.VISCOSITY
    return Network(
        inlet_node=inlet_node,
        outlet_node=outlet_node,
        length=length,
        inlet_radius=inlet,
        outlet_radius=outlet,
        stiffness=np.stack(
            [arteries.WALL_K1 * ones, arteries.WALL_K2 * ones, k3 * ones]
        ),
        wall_viscosity=np.stack([b0 * viscous, b1 * viscous]),
        reference_pressure=subject.diastolic_pressure * MMHG * ones,
        friction=friction / arteries.DENSITY * ones,
        density=arteries.DENSITY,
        source_node=int(inlet_node[arteries.AORTIC_ROOT - 1]),
        outlets=_outlets(outlet, k3, subject),
    )


def carotid_femoral_velocity(
    length: np.ndarray, inlet_radius: np.ndarray, outlet_radius: np.ndarray, k3: float
) -> float:
    r"""Return the pulse wave velocity between carotid and femoral artery, in m/s.

    .. math:: \frac{L_f - L_c}{t_f - t_c}, \qquad t = \sum_i L_i / c_i

    with the wave velocity :math:`c_i` at the mean radius of a segment. Paths end in
    the middle of their last segment.

    Lengths and radii, of both ends of the 116 segments, are in m, the stiffness
    :math:`k_3` in kg s^-2 m^-1.
    """
    distance, time = np.zeros(2), np.zeros(2)
    for i, path in enumerate(PATHS):
        segment = np.array(path) - 1
        share, middle = np.ones(len(path)), np.full(len(path), 0.5)
        share[-1], middle[-1] = 0.5, 0.25
        inlet, outlet = inlet_radius[segment], outlet_radius[segment]
        radius = inlet + middle * (outlet - inlet)
        speed = wave_speed(radius, k3)
        distance[i] = (share * length[segment]).sum()
        time[i] = (share * length[segment] / speed).sum()
    return float((distance[1] - distance[0]) / (time[1] - time[0]))


def wave_speed(radius: np.ndarray, k3: float) -> np.ndarray:
    """Return the velocity of waves at the reference pressure, in m/s."""
    stiffness = _stiffness(radius, arteries.WALL_K1, arteries.WALL_K2, k3)
    return np.sqrt(2 / 3 * stiffness / (arteries.DENSITY * radius))


def _stiffness(radius: np.ndarray, k1: float, k2: float, k3: float) -> np.ndarray:
    return radius * (k1 * np.exp(k2 * radius) + k3)


def _radii(
    inlet: np.ndarray, outlet: np.ndarray, subject: Subject
) -> tuple[np.ndarray, np.ndarray]:
    inlet_node, outlet_node, *_ = arteries.SEGMENTS
    large = (inlet + outlet) / 2 >= arteries.LARGE_RADIUS
    # Branches of large arteries begin as wide as the table has it relative to them.
    begins_large = large | np.isin(inlet_node, outlet_node[large])
    factor = subject.diameter_factor
    return np.where(begins_large, factor, 1.0) * inlet, np.where(
        large, factor, 1.0
    ) * outlet


def _solve_stiffness(
    length: np.ndarray, inlet: np.ndarray, outlet: np.ndarray, subject: Subject
) -> float:
    """Return the k3 that gives a subject's pulse wave velocity, in kg s^-2 m^-1."""

    def excess(log_k3: float) -> float:
        speed = carotid_femoral_velocity(length, inlet, outlet, np.exp(log_k3))
        return speed - subject.pulse_wave_velocity

    ways = [length[np.array(path) - 1] for path in PATHS]
    carotid, femoral = (float(way.sum() - way[-1] / 2) for way in ways)
    low, high = np.log(STIFFNESS_RANGE)
    if femoral <= carotid or excess(low) > 0 or excess(high) < 0:
        raise SimulationError(
            "Expected arteries in which a pulse wave velocity of "
            f"{subject.pulse_wave_velocity:g} m/s is possible; got {carotid:.2g} m "
            f"from the heart to the carotid and {femoral:.2g} m to the femoral artery."
        )
    return float(np.exp(brentq(excess, low, high, xtol=1e-10)))  # type: ignore[arg-type]


def _outlets(outlet_radius: np.ndarray, k3: float, subject: Subject) -> Outlets:
    segment, resistance, compliance = [], [], []
    for bed, bed_resistance, bed_compliance in arteries.BEDS:
        index = np.array(bed) - 1
        share = outlet_radius[index] ** 2 / (outlet_radius[index] ** 2).sum()
        segment.append(index)
        resistance.append(bed_resistance * MMHG / ML / share)
        compliance.append(bed_compliance * ML / MMHG * share)
    segment = np.concatenate(segment)
    radius = outlet_radius[segment]
    impedance = arteries.DENSITY * wave_speed(radius, k3) / (np.pi * radius**2)
    total = np.concatenate(resistance) + impedance
    output = subject.stroke_volume * ML / subject.period
    drop = (subject.mean_pressure - subject.outflow_pressure) * MMHG
    total *= drop / output * (1 / total).sum()
    # Waves leave without reflection where R1 is the characteristic impedance. That of
    # the one tube for all intercostal arteries is nearly all there is, or more.
    proximal = np.minimum(impedance, MAX_PROXIMAL * total)
    return Outlets(
        segment=segment,
        proximal_resistance=proximal,
        distal_resistance=total - proximal,
        compliance=np.concatenate(compliance) * subject.compliance_factor,
        pressure=subject.outflow_pressure * MMHG,
    )
