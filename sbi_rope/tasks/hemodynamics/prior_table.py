"""The density of stroke volume and ejection time, by quadrature."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.special import ndtr
from torch import Tensor

from sbi_rope.tasks.hemodynamics import population_tables as tables
from sbi_rope.tasks.hemodynamics.population import (
    TRUNCATION,
    ejection_time_slopes,
)

GRID = (257, 129)  # points across stroke volumes, and along ejection times
NUM_AGES = 96
MARGINAL_POINTS = 2049


@dataclass(frozen=True)
class Band:
    r"""A parallelogram of stroke volumes :math:`V` and ejection times :math:`t_e`.

    .. math:: V_0 \le V \le V_1, \qquad
        0 \le t_e - (t_0 + b V) \le w .

    Attributes:
        volumes: Least and largest stroke volume, in ml.
        intercept: Least ejection time :math:`t_0` at no stroke volume, in ms.
        slope: Its increase :math:`b` with the stroke volume, in ms/ml.
        width: Span :math:`w` of the ejection times, in ms.
    """

    volumes: tuple[float, float]
    intercept: float
    slope: float
    width: float

    @property
    def area(self) -> float:
        """Its area, in ml ms."""
        return (self.volumes[1] - self.volumes[0]) * self.width

    def theta(self, shares: Tensor) -> Tensor:
        """Return the parameters at relative positions, both shape ``(..., 2)``."""
        low, high = self.volumes
        volume = low + (high - low) * shares[..., 0]
        start = self.intercept + self.slope * volume
        return torch.stack([volume, start + self.width * shares[..., 1]], dim=-1)

    def shares(self, theta: Tensor) -> Tensor:
        """Return relative positions, in [0, 1] inside, float64."""
        volume, time = theta.double().unbind(dim=-1)
        low, high = self.volumes
        start = self.intercept + self.slope * volume
        return torch.stack(
            [(volume - low) / (high - low), (time - start) / self.width], dim=-1
        )

    def log_widths(self, like: Tensor) -> Tensor:
        """Return the logarithms of both spans, shape ``(2,)``."""
        spans = [self.volumes[1] - self.volumes[0], self.width]
        return like.new_tensor(spans).log()


@dataclass(frozen=True)
class PriorTable:
    """A density on a grid, with what follows from it.

    Attributes:
        band: The support.
        density: Density relative to a uniform one at relative positions in the band,
            the bilinear interpolation of which has mean one, shape ``GRID``.
        mean: Means in ml and ms.
        variance: Variances in ml^2 and ms^2.
        marginal_grid: Values of each parameter, shape ``(2, points)``.
        marginal_cdf: Their probabilities not to be exceeded, same shape.
    """

    band: Band
    density: np.ndarray
    mean: tuple[float, float]
    variance: tuple[float, float]
    marginal_grid: np.ndarray
    marginal_cdf: np.ndarray


@lru_cache(maxsize=1)
def prior_table() -> PriorTable:
    """Return the table of the population's law, made once."""
    band = _band()
    across, along = (np.linspace(0.0, 1.0, points) for points in GRID)
    volume = band.volumes[0] + (band.volumes[1] - band.volumes[0]) * across
    start = band.intercept + band.slope * volume
    density = _density(volume, start[:, None] + band.width * along)
    density = density / _integral(density)
    grid, cdf = _marginals(band, density)
    mean, variance = _moments(band, density)
    return PriorTable(band, density, mean, variance, grid, cdf)


def _band() -> Band:
    age = np.array(tables.AGES)
    mean, sd = tables.stroke_volume_law(age)  # linear in age
    low, high = (mean - TRUNCATION * sd).min(), (mean + TRUNCATION * sd).max()
    # Linear between the tabulated ages: extreme at one of them, or at the ends.
    rates = tables.heart_rate_mean(np.clip(tables.HR_AGES, *age))
    spread = TRUNCATION * tables.HEART_RATE_SD
    fastest, slowest = rates.max() + spread, rates.min() - spread
    time, slope, noise_sd = ejection_time_slopes()
    at_none, at_one = (tables.weissler_time(v, fastest) for v in (0.0, 1.0))
    span = slope * (tables.weissler_time(0.0, slowest) - at_none)
    return Band(
        volumes=(float(low), float(high)),
        intercept=float(time + slope * at_none - TRUNCATION * noise_sd),
        slope=float(slope * (at_one - at_none)),
        width=float(span + 2 * TRUNCATION * noise_sd),
    )


def _density(volume: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the density up to a factor, (volumes, times), by Gauss-Legendre in age."""
    nodes, weights = np.polynomial.legendre.leggauss(NUM_AGES)
    first, last = _ages_with(volume)
    density = np.zeros_like(time)
    for node, weight in zip(nodes, weights, strict=True):
        age = first + (last - first) * (node + 1) / 2
        mean, sd = tables.stroke_volume_law(age)
        share = weight * (last - first) * _normal((volume - mean) / sd) / sd
        density += share[:, None] * _time_density(volume, time, age)
    return density


def _ages_with(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return from which to which age a stroke volume is within the cut law."""
    edges = []
    for sign in (-1, 1):
        at_birth, at_one = (
            mean + sign * TRUNCATION * sd
            for mean, sd in map(tables.stroke_volume_law, (0.0, 1.0))
        )
        # Both bounds decrease with age.
        age = (volume - at_birth) / (at_one - at_birth)
        edges.append(np.clip(age, *tables.AGES))
    return edges[0], edges[1]


def _time_density(volume: np.ndarray, time: np.ndarray, age: np.ndarray) -> np.ndarray:
    r"""Return the density of the ejection time given volume and age, up to a factor.

    What the means leave is :math:`r = -b x + \sigma e`, with standard normal heart
    rate :math:`x` and noise :math:`e`, both cut at 2. Given :math:`r`, :math:`x` is
    normal with mean :math:`-b r / (\sigma^2 + b^2)`, cut where either of them is.
    """
    intercept, slope, noise_sd = ejection_time_slopes()
    expected = intercept + slope * tables.weissler_time(
        volume, tables.heart_rate_mean(age)
    )
    rest = time - expected[:, None]
    by_rate = slope * 0.9 * tables.HEART_RATE_SD
    total_sd = np.hypot(noise_sd, by_rate)
    mean, sd = -by_rate * rest / total_sd**2, noise_sd / total_sd
    low = np.maximum(-TRUNCATION, (-TRUNCATION * noise_sd - rest) / by_rate)
    high = np.minimum(TRUNCATION, (TRUNCATION * noise_sd - rest) / by_rate)
    inside = ndtr((high - mean) / sd) - ndtr((low - mean) / sd)
    return _normal(rest / total_sd) * np.maximum(0.0, inside)


def _normal(x: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * x**2)


def _integral(density: np.ndarray) -> float:
    """Return the mean of the bilinear interpolation over the unit square."""
    return float(_cumulative(_cumulative(density)[:, -1])[-1])


def _moments(
    band: Band, density: np.ndarray
) -> tuple[tuple[float, float], tuple[float, float]]:
    shares, weights = _quadrature(density)
    theta = band.theta(torch.from_numpy(shares)).numpy()
    mean = weights @ theta
    variance = weights @ (theta - mean) ** 2
    return (float(mean[0]), float(mean[1])), (float(variance[0]), float(variance[1]))


def _quadrature(density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (points, 2) and masses (points,), Gauss's two in each cell."""
    inner = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    places = [
        (np.arange(points - 1)[:, None] + inner).ravel() / (points - 1)
        for points in GRID
    ]
    # Bilinear interpolation, one axis after the other.
    values = density
    for axis, place in enumerate(places):
        nodes = np.linspace(0.0, 1.0, GRID[axis])
        values = np.apply_along_axis(
            lambda line, place=place, nodes=nodes: np.interp(place, nodes, line),
            axis,
            values,
        )
    shares = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 2)
    return shares, values.ravel() / values.sum()


def _marginals(band: Band, density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid for each parameter and its distribution function there."""
    across, along = (np.linspace(0.0, 1.0, points) for points in GRID)
    volume = band.volumes[0] + (band.volumes[1] - band.volumes[0]) * across
    start = band.intercept + band.slope * volume
    volumes = np.linspace(*band.volumes, MARGINAL_POINTS)
    times = np.linspace(start[0], start[-1] + band.width, MARGINAL_POINTS)
    below = _cumulative(density)  # up to a time, given the volume
    of_volume = np.interp(volumes, volume, _cumulative(below[:, -1]))
    by_volume = [
        np.interp((times - first) / band.width, along, row)
        for first, row in zip(start, below, strict=True)
    ]
    of_time = _cumulative(np.stack(by_volume, axis=1))[:, -1]
    return np.stack([volumes, times]), np.stack([of_volume, of_time])


def _cumulative(values: np.ndarray) -> np.ndarray:
    """Return the integral of a piecewise linear function on [0, 1] up to each point."""
    pieces = (values[..., 1:] + values[..., :-1]) / 2 / (values.shape[-1] - 1)
    return np.concatenate(
        [np.zeros_like(values[..., :1]), pieces.cumsum(axis=-1)], axis=-1
    )
