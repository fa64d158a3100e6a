"""The simulations that a batch is compared with, and the parameters they imply."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sbi_rope.coupling import Coupling
from sbi_rope.utils.tensors import divisors

# Points at which distribution functions are compared.
NUM_POINTS = 100
# So many simulations give a covariance with errors of a few per cent.
MAX_FOR_NOISE = 2000
CHUNK = 500
NUM_DRAWS = 1000  # of batches of simulations


@dataclass(frozen=True, eq=False)
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

    @cached_property
    def noise(self) -> Tensor:
        r"""Covariance :math:`W` of :math:`h(x_s)` given theta, ``(l, l)``.

        It is estimated from differences between simulations with neighbouring
        parameters, without a quadratic trend. With many parameters and few simulations,
        neighbours are far apart and the estimate is too large.
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
        the mean of this given x, to first order :math:`\mu + (I - W V^{-1})(h - \mu)`,
        with V the covariance of h. Without tuning, h is not changed.
        """
        if not self.tuned:
            return points
        mean = self.embedded.mean(dim=0)
        centred = self.embedded - mean
        values, vectors = torch.linalg.eigh(centred.T @ centred / len(centred))
        kept = values > 1e-10 * values.max()
        root = vectors[:, kept] * values[kept].sqrt()
        inverse = vectors[:, kept] / values[kept].sqrt()
        share, basis = torch.linalg.eigh(inverse.T @ self.noise @ inverse)
        left = (1.0 - share).clamp(0.0, 1.0)
        return mean + (points - mean) @ (inverse @ (basis * left) @ basis.T @ root.T)


def nearest_distances(points: Tensor, among: Tensor, *, others: bool = False) -> Tensor:
    """Return the distance from each point to the nearest of others, shape ``(n,)``.

    With ``others`` a point is compared with all but the one in its own row.
    """
    nearest = []
    for rows in torch.arange(len(points)).split(CHUNK):
        distance = torch.cdist(points[rows], among)
        if others:
            distance.scatter_(1, rows[:, None], torch.inf)
        nearest.append(distance.amin(dim=1))
    return torch.cat(nearest)


def implied_by(
    coupling: Coupling, points: Tensor, theta: Tensor, *, others: bool = False
) -> tuple[Tensor, Tensor]:
    r"""Return the parameters that embeddings ``(n, l)`` imply.

    Point i gives simulation j the weight :math:`\operatorname{softmax}_j(-C_{ij} /
    \gamma)`. With ``others`` it is not matched with the simulation in its own row.

    Returns:
        The mean weights of the simulations, ``(n_s,)``, which sum to one; and the
        distribution functions of each point, ``(n, d, NUM_POINTS)``.
    """
    order, last = theta.argsort(dim=0), len(theta) - 1
    # The ranks at which distribution functions are compared.
    where = torch.linspace(0, last, min(NUM_POINTS, len(theta))).round().long()
    total, functions = torch.zeros(len(theta), dtype=torch.float64), []
    for rows in torch.arange(len(points)).split(CHUNK):
        weights = coupling.rows(points[rows])
        if others:
            weights = weights.scatter(1, rows[:, None], 0.0)
            weights /= weights.sum(dim=1, keepdim=True).clamp_min(1e-300)
        total += weights.sum(dim=0)
        each = [weights[:, column].cumsum(dim=1)[:, where] for column in order.T]
        functions.append(torch.stack(each, dim=1))
    return total / len(points), torch.cat(functions)


def resampled(values: Tensor, size: int) -> Tensor:
    """Return means over ``size`` rows drawn with replacement, ``(1000, ...)``."""
    count = len(values)
    rows = torch.randint(count, (NUM_DRAWS, size))
    rows += count * torch.arange(NUM_DRAWS).unsqueeze(1)
    times = torch.bincount(rows.flatten(), minlength=NUM_DRAWS * count)
    draws = times.reshape(NUM_DRAWS, count).to(values)
    mean = draws @ values.reshape(count, -1) / size
    return mean.reshape(NUM_DRAWS, *values.shape[1:])
