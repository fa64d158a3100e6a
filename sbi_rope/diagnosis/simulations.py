"""The simulations a batch is compared with, and what tuning would make of them."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sbi_rope._slices import slices

__all__ = ["Simulations", "nearest_distances"]

# Simulations behind a covariance: its errors are then a few per cent.
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

        From differences between simulations with neighbouring parameters, after a
        quadratic trend is taken out. Needs no further simulations. Where parameters are
        many and simulations few, neighbours are far apart and it is too large.
        """
        theta, embedded = self.theta[:MAX_FOR_NOISE], self.embedded[:MAX_FOR_NOISE]
        standard = (theta - theta.mean(dim=0)) / theta.std(dim=0).clamp_min(1e-12)
        ones = torch.ones_like(standard[:, :1])
        features = torch.cat([ones, standard, standard.square()], dim=1)
        residual = embedded - features @ (torch.linalg.pinv(features) @ embedded)
        distance = torch.cdist(standard, standard).fill_diagonal_(torch.inf)
        difference = residual - residual[distance.argmin(dim=1)]
        return difference.T @ difference / (2 * len(difference))

    @cached_property
    def averaged(self) -> Tensor:
        """Embeddings as g would give them if simulations were real, ``(n_s, l)``."""
        return self.average(self.embedded)

    def average(self, points: Tensor) -> Tensor:
        r"""Move embeddings ``(n, l)`` as tuning would if all were well.

        Tuning moves :math:`g(x)` to :math:`E[h \mid \theta]`, of which an observation
        tells no more than its mean given x: the noise of single simulations is
        averaged out, and what is left is drawn to the centre. To first order that is
        :math:`\mu + (I - W V^{-1})(h - \mu)`, V the covariance of h. Without tuning h
        stays as it is.
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
        """Distance from each simulation to the nearest other, ``(n_s,)``."""
        return nearest_distances(self.embedded, self.embedded, others=True)


def nearest_distances(points: Tensor, among: Tensor, *, others: bool = False) -> Tensor:
    """Return the distance from each point to the nearest of some, shape ``(n,)``.

    Args:
        points: Shape ``(n, l)``.
        among: Shape ``(m, l)``.
        others: Whether the two sets are the same, and no point is its own neighbour.
    """
    nearest = []
    for block in slices(len(points), CHUNK):
        distance = torch.cdist(points[block], among)
        if others:
            own = torch.arange(len(distance))
            distance[own, block.start + own] = torch.inf
        nearest.append(distance.amin(dim=1))
    return torch.cat(nearest)
