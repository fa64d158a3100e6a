r"""Pressure in a wind tunnel while its intake fan speeds up and slows down again."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Annotated

import torch
from torch import Tensor

from sbi_rope.utils.settings import (
    NotNegative,
    Number,
    Positive,
    Range,
    Settings,
    UnitInterval,
)
from sbi_rope.utils.tensors import as_batch

NUM_STEPS = 50
FIRST_LOADED, LAST_LOADED = 5, 24  # samples taken at full load of the intake fan


def _evenly(first: float, last: float, num: int) -> tuple[float, ...]:
    step = (last - first) / (num - 1)
    return (*(first + i * step for i in range(num - 1)), last)


# When the samples are taken, in s: the recorded times of one impulse. Those of samples
# 6 to 23 and 26 to 48 are evenly spaced here, which is right to about a millisecond.
SAMPLE_TIMES = (
    *(0.0, 0.15156, 0.30313, 0.45462, 0.61425),
    *_evenly(0.78639, 3.66501, 20),
    *_evenly(3.94014, 7.58541, 25),
)
# A load holds over the interval before the sample that is taken under it.
IMPULSE = (SAMPLE_TIMES[FIRST_LOADED - 1], SAMPLE_TIMES[LAST_LOADED])
INTAKE_LOADS = (0.01, 1.0)  # outside of and during the impulse
EXHAUST_LOADS = (0.5, 0.5)

# Constants of the two models as published with the causal chambers.
MIN_LOAD = 0.1  # a fan at a smaller load turns as fast as at this one
FULL_TORQUE = 0.05 * (0.27 - 0.166)  # N m: 0.05 N m/A times the current at full load
MAX_SPEED = 3000 * math.pi / 30  # rad/s
DRAG = FULL_TORQUE / MAX_SPEED**2  # N m s^2
INERTIA = 0.5 * 0.059**2 * 0.02  # kg m^2, of a disc of radius 5.9 cm and 20 g
MAX_PRESSURE = 74.82473949999999  # Pa
CLOSED_RATIO, HATCH_EFFECT = 0.75, 0.15  # airflow ratio, and what the hatch adds to it
MAX_HATCH = 45.0  # degrees

# With a larger shift an impulse would begin before the first sample.
MAX_JITTER = 0.6  # s
SUBSTEPS = 100
SHIFT_STEP = 1e-3  # s


@dataclass(frozen=True, kw_only=True)
class WindTunnelSimulator(Settings):
    r"""Pressure in a wind tunnel above ambient, at 50 times around an impulse.

    The fan in front is switched from idle to full load for three seconds while the
    fan at the back turns steadily. With :math:`\tau(L)` the torque at load :math:`L`,
    the speed :math:`\omega` of a fan follows (model A2)

    .. math:: I \dot\omega = \tau(L(t)) - K \omega^2, \qquad
        \tau(L) = \max(L, 0.1)^3 K \omega_{\max}^2,

    solved by Euler's method with 100 steps between two samples. A fan then makes the
    static pressure at which its linear characteristic meets the impedance of the
    tunnel, which depends on the hatch :math:`H` through the airflow ratio :math:`r`
    (model C3). The intersection has a closed form, so that

    .. math:: x(t) = S_{\max} (1 - r(H)) s(t - \delta) + \varepsilon_t, \quad
        s = \frac{\omega_{in}^2 - \omega_{out}^2}{\omega_{\max}^2}, \quad
        r(H) = \min(1, 0.75 + 0.15 H / 45).

    The impulse is shifted by an unknown :math:`\delta \sim \mathcal{U}(-J, J)`, where
    an Euler step that it begins or ends in gets its share of the torque. Noise is
    Gaussian, independent between samples unless ``noise_correlation`` makes it
    autoregressive. Since :math:`s` does not depend on :math:`H`, it is tabulated once
    for shifts a millisecond apart and interpolated, to 2e-5 Pa. Calculations are in
    float64, the result has the dtype of theta.

    References:
        | Causal chambers as a real-world physical testbed for AI methodology
          (Gamella, Peters and Bühlmann, 2025), models A2 and C3
        | https://doi.org/10.1038/s42256-024-00964-x
        | https://github.com/juangamella/causal-chamber-package,
          ``models.simulator_a2_c3`` (MIT licence)

    Args:
        noise_std: Standard deviation of the barometer's noise, in Pa.
        onset_jitter: The largest shift :math:`J` of the impulse, in s; at 0 its time
            is known.
        noise_correlation: Correlation between the noise of neighbouring samples.
        max_pressure: Pressure :math:`S_{\max}` of a fan in a closed tunnel, in Pa.
        inertia: Moment of inertia :math:`I` of a fan, in kg m^2.
        exhaust_offset: Added to the speed of the fan at the back, in rad/s.

    Example:
        >>> WindTunnelSimulator()(torch.tensor([[0.0], [45.0]])).shape
        torch.Size([2, 50])
    """

    noise_std: NotNegative = 0.2
    onset_jitter: Annotated[float, Range(0, MAX_JITTER)] = 0.3
    noise_correlation: UnitInterval = 0.0
    max_pressure: Positive = MAX_PRESSURE
    inertia: Positive = INERTIA
    exhaust_offset: Number = 0.0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 1)``, to shape ``(n, 50)``."""
        theta = as_batch("theta", theta, (1,), empty=True)
        position = torch.rand_like(theta[:, 0], dtype=torch.float64)
        shift = self.onset_jitter * (2 * position - 1)
        pressure = self.pressure(theta, onset_shift=shift)
        noise = torch.randn_like(pressure)
        if self.noise_correlation:
            noise = noise @ _autoregression(self.noise_correlation).to(noise)
        return (pressure + self.noise_std * noise).to(theta.dtype)

    def pressure(self, theta: Tensor, *, onset_shift: Tensor) -> Tensor:
        """Return the pressure ``(n, 50)`` in Pa without noise, differentiable.

        ``onset_shift`` is when the impulse begins after its usual time, in s, shape
        ``(n,)``, float64; at most ``onset_jitter`` before or after.
        """
        ratio = CLOSED_RATIO + HATCH_EFFECT * theta.double() / MAX_HATCH
        scale = self.max_pressure * (1 - ratio.clamp(max=1.0))
        return scale * self._interpolate(onset_shift)

    def _interpolate(self, onset_shift: Tensor) -> Tensor:
        table = _tabulated_ratio(self.onset_jitter, self.inertia, self.exhaust_offset)
        shifts, ratios = (part.to(onset_shift.device) for part in table)
        if not self.onset_jitter:
            return ratios.expand(len(onset_shift), NUM_STEPS)
        above = torch.searchsorted(shifts, onset_shift).clamp(1, len(shifts) - 1)
        low, high = shifts[above - 1], shifts[above]
        weight = ((onset_shift - low) / (high - low)).unsqueeze(1)
        return torch.lerp(ratios[above - 1], ratios[above], weight)


def pressure_ratio(
    onset_shift: Tensor, *, inertia: float = INERTIA, exhaust_offset: float = 0.0
) -> Tensor:
    r"""Return :math:`s = (\omega_{in}^2 - \omega_{out}^2) / \omega_{\max}^2`.

    It is a number at each of the 50 times, shape ``(n, 50)``, by Euler's method for
    shifts of the impulse in s, shape ``(n,)``, float64.
    """
    intake = _fan_speeds(onset_shift, loads=INTAKE_LOADS, inertia=inertia)
    exhaust = _fan_speeds(onset_shift[:1], loads=EXHAUST_LOADS, inertia=inertia)
    return (intake**2 - (exhaust + exhaust_offset) ** 2) / MAX_SPEED**2


def _fan_speeds(
    onset_shift: Tensor, *, loads: tuple[float, float], inertia: float
) -> Tensor:
    rest, full = (max(load, MIN_LOAD) ** 3 * FULL_TORQUE for load in loads)
    begin, end = (time + onset_shift for time in IMPULSE)
    # Fans start at the speed that is proportional to their load, faster than the one
    # at which torque and drag agree: a transient that belongs to the published model.
    speed = torch.full_like(onset_shift, max(loads[0], MIN_LOAD) * MAX_SPEED)
    speeds = [speed]
    for last, time in pairwise(SAMPLE_TIMES):
        step = (time - last) / SUBSTEPS
        for i in range(SUBSTEPS):
            start = last + i * step
            inside = end.clamp(max=start + step) - begin.clamp(min=start)
            torque = rest + (full - rest) * (inside / step).clamp(0.0, 1.0)
            speed = speed + step / inertia * (torque - DRAG * speed**2)
        speeds.append(speed)
    return torch.stack(speeds, dim=1)


@lru_cache(maxsize=32)
def _tabulated_ratio(
    onset_jitter: float, inertia: float, exhaust_offset: float
) -> tuple[Tensor, Tensor]:
    num_steps = 2 * math.ceil(onset_jitter / SHIFT_STEP) + 1
    shifts = torch.linspace(
        *(-onset_jitter, onset_jitter, num_steps), dtype=torch.float64, device="cpu"
    )
    # Where an edge of the impulse passes a sample, the ratio has a kink.
    times = shifts.new_tensor(SAMPLE_TIMES)
    kinks = torch.cat([times - edge for edge in IMPULSE])
    kinks = kinks[kinks.abs() < onset_jitter]
    shifts = torch.cat([shifts, kinks]).unique()
    return shifts, pressure_ratio(
        shifts, inertia=inertia, exhaust_offset=exhaust_offset
    )


def _autoregression(correlation: float) -> Tensor:
    """Return the matrix, (50, 50), that correlates rows of independent noise."""
    step = torch.arange(NUM_STEPS, dtype=torch.float64, device="cpu")
    lag = step - step.unsqueeze(1)
    decay = torch.where(lag < 0, 0.0, correlation ** lag.clamp(min=0.0))
    # All samples have unit variance: the first has no past to add to its noise.
    innovation = torch.full_like(step, math.sqrt(1 - correlation**2))
    innovation[0] = 1.0
    return innovation.unsqueeze(1) * decay
