"""The law of the hearts and arteries of healthy men of 25 to 75 years."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from scipy.special import ndtr, ndtri

from sbi_rope.tasks.hemodynamics import population_tables as tables
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Subject
from sbi_rope.utils.settings import Range, Settings

Process = Literal["simulator", "real"]
PROCESSES = ("simulator", "real")
# What varies beside theta = (stroke volume, ejection time), as stored with a data set.
NUISANCES = (
    "age",
    "heart_rate",
    "peak_flow_time",
    "regurgitant_volume",
    "mean_pressure",
    "diastolic_pressure",
    "outflow_pressure",
    "pulse_wave_velocity",
    "diameter_factor",
    "compliance_factor",
)

TRUNCATION = 2.0  # standard deviations at which every normal law is cut
TRUNCATED_SD = 0.8796256610342398  # of a standard normal law cut there
QUANTILE_90 = 1.2815515655446004  # of a standard normal law
EXPLAINED = 0.7  # correlation of ejection time and its prediction by Weissler
MAX_PEAK_SHARE = 0.45  # of the ejection
MEAN_HEIGHT = 1.70  # m
PROXIMAL_AORTA = (0, 1)  # indices of ascending aorta and first part of the arch


@dataclass(frozen=True, kw_only=True)
class Population(Settings):
    r"""The joint law of a person's heart, arteries and microvasculature.

    Age is uniform from 25 to 75 years. Given the age, stroke volume :math:`V`, heart
    rate :math:`f`, mean pressure, and the relative diameter of large arteries and
    compliance of the periphery are normal, as are peak flow time, reverse flow and
    outflow pressure at any age; all are cut at two standard deviations, and a
    physical bound where there is one. The ejection time follows

    .. math:: t_e = 282 + 23.3 \left(0.7 \frac{w - \bar w}{s_w}
        + \sqrt{1 - 0.7^2} \, \varepsilon\right)~\mathrm{ms},
        \quad w = 266 + 1.1 (V - 82) - 0.9 (f - 73),

    with Weissler's prediction :math:`w`, its mean :math:`\bar w` and standard
    deviation :math:`s_w` over people of all ages, and a standard normal
    :math:`\varepsilon`, cut as well. So stroke volume and ejection time have a
    correlation of 0.63, and the ejection takes at most 0.55 of the beat without
    anybody being turned away. The pulse-wave velocity has the median of the age, times
    the trend with mean pressure, and a spread that is wider above than below. The
    arteries have their tabulated radii at the mean diastolic pressure of the age.

    These laws are those of the simulator and of the real process. The simulator gives
    everyone the lengths of the table. In the real process, segment :math:`i` has the
    length

    .. math:: L_i = L_{i, 0} \, \frac{h}{1.70} \, e^{s \varepsilon_i}, \qquad
        h \sim \mathcal{N}(1.70, \sigma_h^2)~\mathrm{m},

    with independent standard normal :math:`\varepsilon_i`, and the proximal aorta
    grows with age besides, with an individual factor of 13.4 %.

    Args:
        height_sd: Standard deviation :math:`\sigma_h` of the height in m.
        segment_sd: Scatter :math:`s` of the logarithm of each segment's length.
        proximal_aorta: Whether the proximal aorta varies by itself in the real
            process. Without it and with both scatters 0, the simulator is exact.

    Example:
        >>> person = Population().draw("simulator", seed=0, index=0)
        >>> 25 < person.age < 75 and set(person.length_factors) == {1.0}
        True
    """

    # At larger scatters, some arteries are all but gone and others metres long.
    height_sd: Annotated[float, Range(0, 0.4)] = 0.10
    segment_sd: Annotated[float, Range(0, 0.5)] = 0.15
    proximal_aorta: bool = True

    def draw(self, process: Process, seed: int, index: int) -> Subject:
        """Return one person of a cohort, always the same for the same arguments.

        Persons are independent of each other, within and between cohorts and processes.
        """
        entropy = [seed, PROCESSES.index(process), index]
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        age, stroke_volume, heart_rate, ejection_time = _draw_heart(rng)
        return Subject(
            age=age,
            heart_rate=heart_rate,
            stroke_volume=stroke_volume,
            ejection_time=ejection_time,
            peak_flow_time=truncated_normal(
                rng,
                *tables.PEAK_FLOW_TIME,
                highest=MAX_PEAK_SHARE * ejection_time,
            ),
            regurgitant_volume=truncated_normal(
                rng, *tables.REGURGITANT_VOLUME, lowest=0.0
            ),
            **_draw_arteries(rng, age),
            length_factors=self._draw_lengths(rng, process, age),
        )

    def _draw_lengths(
        self, rng: np.random.Generator, process: Process, age: float
    ) -> tuple[float, ...]:
        if process == "simulator":
            return (1.0,) * NUM_SEGMENTS
        height = truncated_normal(rng, MEAN_HEIGHT, self.height_sd)
        scatter = rng.standard_normal(NUM_SEGMENTS)
        factors = height / MEAN_HEIGHT * np.exp(self.segment_sd * scatter)
        growth = truncated_normal(rng, 1.0, tables.AORTA_LENGTH_SD)
        if self.proximal_aorta:
            factors[list(PROXIMAL_AORTA)] *= growth * tables.aorta_growth(age)
        return tuple(factors.tolist())


def _draw_heart(rng: np.random.Generator) -> tuple[float, ...]:
    """Return age, stroke volume in ml, heart rate in 1/min, ejection time in ms."""
    age = float(rng.uniform(*tables.AGES))
    rate_mean = float(tables.heart_rate_mean(age))
    heart_rate = truncated_normal(rng, rate_mean, tables.HEART_RATE_SD)
    mean, sd = tables.stroke_volume_law(age)
    stroke_volume = truncated_normal(rng, float(mean), float(sd))
    time, slope, noise_sd = ejection_time_slopes()
    predicted = time + slope * tables.weissler_time(stroke_volume, heart_rate)
    ejection_time = truncated_normal(rng, float(predicted), noise_sd)
    return age, stroke_volume, heart_rate, ejection_time


def _draw_arteries(rng: np.random.Generator, age: float) -> dict[str, float]:
    usual, sd = tables.pressure_law(age)
    mean_pressure = truncated_normal(rng, usual, sd)
    low, median, high = tables.velocity_quantiles(age)
    deviation = truncated_normal(rng, 0.0, 1.0) / QUANTILE_90
    velocity = median + deviation * (high - median if deviation > 0 else median - low)
    trend = tables.velocity_trend(age, mean_pressure)
    return {
        "mean_pressure": mean_pressure,
        "diastolic_pressure": tables.diastolic_pressure(age),
        "outflow_pressure": truncated_normal(rng, *tables.OUTFLOW_PRESSURE),
        "pulse_wave_velocity": velocity * trend / tables.velocity_trend(age, usual),
        "diameter_factor": tables.diameter_growth(age)
        * truncated_normal(rng, 1.0, tables.DIAMETER_SD),
        "compliance_factor": tables.compliance_mean(age)
        * truncated_normal(rng, 1.0, tables.COMPLIANCE_SD),
    }


def truncated_normal(
    rng: np.random.Generator,
    mean: float,
    sd: float,
    *,
    lowest: float = -np.inf,
    highest: float = np.inf,
) -> float:
    """Draw a normal number, cut at two standard deviations and at bounds."""
    if sd == 0.0:
        rng.uniform()  # what follows must not depend on the spread
        return mean
    low = ndtr(max(-TRUNCATION, (lowest - mean) / sd))
    high = ndtr(min(TRUNCATION, (highest - mean) / sd))
    return float(mean + sd * ndtri(rng.uniform(low, high)))


@lru_cache(maxsize=1)
def ejection_time_slopes() -> tuple[float, float, float]:
    """Return how the ejection time follows from Weissler's prediction.

    That is by its intercept in ms, its slope, and the standard deviation in ms of what
    the prediction leaves open, before it is cut.
    """
    low, high = tables.AGES
    nodes, weights = np.polynomial.legendre.leggauss(200)
    age = low + (high - low) * (nodes + 1) / 2
    volume_mean, volume_sd = tables.stroke_volume_law(age)
    by_age = tables.weissler_time(volume_mean, tables.heart_rate_mean(age))
    mean = weights @ by_age / 2
    # The spread within an age, and that of the ages.
    within = (1.1 * volume_sd) ** 2 + (0.9 * tables.HEART_RATE_SD) ** 2
    variance = weights @ (TRUNCATED_SD**2 * within + (by_age - mean) ** 2) / 2
    time_mean, time_sd = tables.EJECTION_TIME
    slope = EXPLAINED * time_sd / np.sqrt(variance)
    noise_sd = time_sd * np.sqrt(1 - EXPLAINED**2)
    return float(time_mean - slope * mean), float(slope), float(noise_sd)
