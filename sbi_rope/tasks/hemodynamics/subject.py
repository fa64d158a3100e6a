"""A person in the model of the circulation, and settings to solve it with."""

from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np

from sbi_rope.errors import InvalidInputError, shown
from sbi_rope.settings import Number, Positive, Range, UnitInterval, check

__all__ = ["NUM_SEGMENTS", "Beat", "Physics", "Subject"]

NUM_SEGMENTS = 116
# Beyond these, a number is taken for a mistake, of units most likely.
PHYSIOLOGICAL = {
    "age": (18.0, 100.0),
    "heart_rate": (30.0, 200.0),
    "stroke_volume": (10.0, 200.0),
    "ejection_time": (100.0, 600.0),
    "peak_flow_time": (20.0, 300.0),
    "regurgitant_volume": (0.0, 20.0),
    "mean_pressure": (50.0, 180.0),
    "diastolic_pressure": (30.0, 140.0),
    "outflow_pressure": (0.0, 50.0),
    "pulse_wave_velocity": (3.0, 20.0),
    "diameter_factor": (0.5, 2.0),
    "compliance_factor": (0.05, 5.0),
}


@dataclass(frozen=True, kw_only=True)
class Subject:
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

    age: float
    heart_rate: float
    stroke_volume: float
    ejection_time: float
    peak_flow_time: float
    regurgitant_volume: float
    mean_pressure: float
    diastolic_pressure: float
    outflow_pressure: float
    pulse_wave_velocity: float
    diameter_factor: float
    compliance_factor: float
    length_factors: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, (low, high) in PHYSIOLOGICAL.items():
            value = getattr(self, name)
            check(name, value, Number)
            if not low <= value <= high:
                raise InvalidInputError(
                    f"Expected `{name}` from {low:g} to {high:g}; got {value!r}. Units "
                    "are years, beats per minute, ml, ms, mmHg and m/s."
                )
        if self.ejection_time >= 1000 * self.period:
            raise InvalidInputError(
                f"Expected `ejection_time` below the length of a beat, "
                f"{1000 * self.period:.0f} ms at this heart rate; got "
                f"{self.ejection_time:g} ms."
            )
        if self.peak_flow_time >= self.ejection_time:
            raise InvalidInputError(
                f"Expected `peak_flow_time` below `ejection_time`; got "
                f"{self.peak_flow_time:g} and {self.ejection_time:g} ms."
            )
        if self.outflow_pressure >= self.mean_pressure:
            raise InvalidInputError(
                f"Expected `outflow_pressure` below `mean_pressure`; got "
                f"{self.outflow_pressure:g} and {self.mean_pressure:g} mmHg."
            )
        _check_factors(self.length_factors)

    @property
    def period(self) -> float:
        """Length of a beat, in s."""
        return 60.0 / self.heart_rate


@dataclass(frozen=True, kw_only=True)
class Physics:
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

    cell_length: float = 0.01
    min_segment_length: float = 0.01
    courant: float = 0.6
    fallback_courant: float = 0.4
    num_cycles: int = 10
    viscoelastic: bool = True
    convection: float = 4 / 3
    max_period_error: float = 0.3

    def __post_init__(self) -> None:
        lengths = ("cell_length", "min_segment_length", "max_period_error")
        for name in (*lengths, "convection"):
            check(name, getattr(self, name), Positive)
        for name in ("courant", "fallback_courant"):
            check(name, getattr(self, name), Positive)
            check(name, getattr(self, name), UnitInterval)
        check("num_cycles", self.num_cycles, Annotated[int, Range(2)])
        check("viscoelastic", self.viscoelastic, bool)

    def as_dict(self) -> dict[str, float | int | bool]:
        """Return all settings by name, as stored with a data set."""
        # Plain numbers, whatever kind they were given as.
        kinds = {"num_cycles": int, "viscoelastic": bool}
        return {
            field.name: kinds.get(field.name, float)(getattr(self, field.name))
            for field in fields(self)
        }


def _check_factors(factors: Any) -> None:
    try:
        values = np.asarray(factors, dtype=float)
    except (TypeError, ValueError, OverflowError):
        values = np.full(0, np.nan)
    if values.shape != (NUM_SEGMENTS,) or not ((values > 0) & (values < np.inf)).all():
        raise InvalidInputError(
            f"Expected `length_factors` to be {NUM_SEGMENTS} positive numbers; got "
            f"{shown(factors)}."
        )


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
