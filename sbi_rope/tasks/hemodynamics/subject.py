"""A person in the model of the circulation, and settings to solve it with."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from sbi_rope.utils.settings import Positive, Range, Settings, UnitInterval

NUM_SEGMENTS = 116


@dataclass(frozen=True, kw_only=True)
class Subject(Settings):
    """A person's heart, arteries and microvasculature.

    Attributes:
        age: In years.
        heart_rate: In beats per minute.
        stroke_volume: Net volume that leaves the heart in a beat, SV, in ml.
        ejection_time: Time between opening and closure of the aortic valve, LVET, in
            ms.
        peak_flow_time: Time from the opening to the peak of the flow, in ms.
        regurgitant_volume: Volume that flows back while the valve closes, in ml.
        mean_pressure: The mean arterial pressure that the peripheral resistance is
            chosen for, in mmHg.
        diastolic_pressure: The pressure at which arteries have their tabulated radii,
            in mmHg.
        outflow_pressure: Pressure behind the peripheral resistance, in mmHg.
        pulse_wave_velocity: Carotid-femoral velocity that the walls' stiffness is
            chosen for, in m/s.
        diameter_factor: Diameter of large arteries relative to the table.
        compliance_factor: Peripheral compliance relative to the table.
        length_factors: Length of each of the 116 segments relative to the table.
    """

    # Beyond these, a number is taken for a mistake, of units most likely.
    age: Annotated[float, Range(18, 100)]
    heart_rate: Annotated[float, Range(30, 200)]
    stroke_volume: Annotated[float, Range(10, 200)]
    ejection_time: Annotated[float, Range(100, 600)]
    peak_flow_time: Annotated[float, Range(20, 300)]
    regurgitant_volume: Annotated[float, Range(0, 20)]
    mean_pressure: Annotated[float, Range(50, 180)]
    diastolic_pressure: Annotated[float, Range(30, 140)]
    outflow_pressure: Annotated[float, Range(0, 50)]
    pulse_wave_velocity: Annotated[float, Range(3, 20)]
    diameter_factor: Annotated[float, Range(0.5, 2)]
    compliance_factor: Annotated[float, Range(0.05, 5)]
    length_factors: tuple[float, ...]

    @property
    def period(self) -> float:
        """Length of a beat, in s."""
        return 60.0 / self.heart_rate


@dataclass(frozen=True, kw_only=True)
class Physics(Settings):
    """Settings with which the equations of blood flow are solved.

    Attributes:
        cell_length: Length of a cell, in m: segments are cut into the number of cells
            that comes closest.
        min_segment_length: Length that shorter segments are stretched to, in m. Pieces
            of a few millimetres would dictate the time step otherwise.
        courant: Courant number, in (0, 1].
        fallback_courant: The Courant number that a failed run is tried again with.
        num_cycles: Beats that are simulated, the last of which is kept.
        viscoelastic: Whether the walls are viscoelastic.
        convection: Momentum correction of the velocity profile; 4/3 is parabolic.
        max_period_error: Largest difference between the last two beats, in mmHg.
    """

    cell_length: Positive = 0.01
    min_segment_length: Positive = 0.01
    courant: UnitInterval = 0.6
    fallback_courant: UnitInterval = 0.4
    num_cycles: Annotated[int, Range(2)] = 10
    viscoelastic: bool = True
    convection: Positive = 4 / 3
    max_period_error: Positive = 0.3


@dataclass(frozen=True, kw_only=True)
class Beat:
    """One converged beat of a subject.

    Attributes:
        period: Length of the beat, in s.
        pressure: Pressure at each site on a fixed phase grid, in mmHg, by name:
            ``"radial"`` (left, mid-segment), ``"brachial"`` and ``"aortic"`` (root),
            each an array of shape ``(num_phases,)`` over one period, end excluded.
        period_error: Largest difference between the last two beats at the radial
            site, in mmHg.
        mass_error: Difference of mean inflow and mean outflow of the last beat, as a
            fraction of the inflow.
        courant: The Courant number that was used in the end.
    """

    period: float
    pressure: dict[str, np.ndarray]
    period_error: float
    mass_error: float
    courant: float
