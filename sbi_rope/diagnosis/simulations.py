"""The simulations that a batch is compared with, and how tuning would move them."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sbi_rope._units import divisors

__all__ = ["Simulations", "nearest_distances"]

# So many simulations give a covariance with errors of a few per cent.
MAX_FOR_NOISE = 2000
CHUNK = 500


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulations:
    r"""Simulations from the prior, in float64 on the CPU.

    Attributes:
        theta: Their parameters, ``(n_s, d)``.
        embedded: :math:`h(x_s)`, ``(n_s, l)``.
        tuned: Whether g was tuned, so that it may average over the simulator's noise.
    """

    theta: Tensor
    embedded: Tensor
    tuned: bool

    def __len__(self) -> int:
        return len(self.theta)

    @cached_property
    def noise(self) -> Tensor:
        r"""Covariance :math:`W` of :math:`h(x_s)` given theta, ``(l, l)``.

        It is estimated from the differences between simulations with neighbouring
        parameters, after a quadratic trend is subtracted. No further simulations are
        needed. With many parameters and few simulations, neighbours are far apart and
        the estimate is too large.
        """
        theta, embedded = self.theta[:MAX_FOR_NOISE], self.embedded[:MAX_FOR_NOISE]
        standard = (theta - theta.mean(dim=0)) / divisors(theta.std(dim=0))
        ones = torch.ones_like(standard[:, :1])
        features = torch.cat([ones, standard, standard.square()], dim=1)
        residual = embedded - features @ (torch.linalg.pinv(features) @ embedded)
        distance = torch.cdist(standard, standard).fill_diagonal_(torch.inf)
        difference = residual - residual[distance.argmin(dim=1)]
        return difference.T @ difference / (2 * len(difference))

    @cached_property
    def averaged(self) -> Tensor:
        """Embeddings of the simulations as a tuned g would have them, ``(n_s, l)``."""
        return self.average(self.embedded)

    def average(self, points: Tensor) -> Tensor:
        r"""Move embeddings ``(n, l)`` as tuning does if nothing is wrong.

        Tuning moves :math:`g(x)` towards :math:`E[h \mid \theta]`. It can reach at best
        the mean of this given x, which averages out the noise of single simulations
        and is drawn to the centre. To first order it is
        :math:`\mu + (I - W V^{-1})(h - \mu)`, with V the covariance of h. Without
        tuning, h is not changed.
        """
        if not self.tuned:
            return points
        mean = self.embedded.mean(dim=0)
        return mean + (points - mean) @ self._averaging

    @cached_property
    def _averaging(self) -> Tensor:
        centred = self.embedded - self.embedded.mean(dim=0)
        values, vectors = torch.linalg.eigh(centred.T @ centred / len(centred))
        kept = values > 1e-10 * values.max()
        root = vectors[:, kept] * values[kept].sqrt()
        inverse = vectors[:, kept] / values[kept].sqrt()
        share, basis = torch.linalg.eigh(inverse.T @ self.noise @ inverse)
        left = (1.0 - share).clamp(0.0, 1.0)
        return inverse @ (basis * left) @ basis.T @ root.T

    @cached_property
    def nearest(self) -> Tensor:
        """Distance from each simulation to its nearest neighbour, ``(n_s,)``."""
        return nearest_distances(self.embedded, self.embedded, others=True)


def nearest_distances(points: Tensor, among: Tensor, *, others: bool = False) -> Tensor:
    """Return the distance from each point to the nearest of others, shape ``(n,)``.

    Args:
        points: Shape ``(n, l)``.
        among: Shape ``(m, l)``.
        others: Whether the two sets are the same, and no point is its own neighbour.
    """
    nearest = []
    for first in range(0, len(points), CHUNK):
        distance = torch.cdist(points[first : first + CHUNK], among)
        if others:
            own = torch.arange(len(distance))
            distance[own, first + own] = torch.inf
        nearest.append(distance.amin(dim=1))
    return torch.cat(nearest)
