"""The simulations that a batch is compared with."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sbi_rope.utils.tensors import divisors

# So many simulations give a covariance with errors of a few per cent.
MAX_FOR_NOISE = 2000
# So many rows of distances are computed at a time.
CHUNK = 500


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
