"""Mixtures over simulations, such as the posterior of RoPE."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope.coupling import Coupling
from sbi_rope.density.base import Accept, Density, batches, num_fitting, without_nan
from sbi_rope.npe.sbi import ConditionalDensityEstimator
from sbi_rope.training.ensemble import drawn, log_density
from sbi_rope.utils.errors import InvalidInputError


class OverSimulations(Density):
    r"""A density that is mixed over simulations, with weights that depend on x.

    .. math:: \sum_j a_j(x)\, q(\theta \mid s_j)

    A subclass defines :meth:`Density.embed` and :meth:`rows`. A matrix of the weights
    of many observations is never held.

    Args:
        density: :math:`q(\theta \mid s)`, an estimator conditioned on embeddings.
        simulated: :math:`s_j`, shape ``(n_s, l)``.
        condition_shape: Shape of one observation.

    Attributes:
        tail_mass: t. The smallest weights of an observation, which sum to at most this,
            are left out of the density, which is then too small by at most t times the
            largest density left out.
    """

    simulated: Tensor
    tail_mass = 1e-3

    def __init__(
        self,
        density: ConditionalDensityEstimator,
        simulated: Tensor,
        condition_shape: Sequence[int],
    ) -> None:
        super().__init__(density.input_shape, condition_shape)
        self.density = density
        self.register_buffer("simulated", simulated)

    @abstractmethod
    def rows(self, z: Tensor) -> Tensor:
        """Return the weights of the simulations, ``(b, n_s)``; rows sum to one."""

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        size, blocks = num_fitting(len(self.simulated)), []
        for points, some in zip(theta.split(size, dim=1), z.split(size), strict=True):
            kept, column, log_weights = without_tail(self.rows(some), self.tail_mass)
            row, column = kept.nonzero()[:, 0], column[kept]
            log_q = []
            for part in points.split(num_fitting(len(row))):
                log_terms = log_weights.repeat(len(part), 1, 1)
                log_terms[:, kept] += self._log_terms(part, row, column)
                log_q.append(log_terms.logsumexp(dim=2))
            blocks.append(torch.cat(log_q))
        return torch.cat(blocks, dim=1)

    def _log_terms(self, theta: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """Evaluate K simulations at theta of their row, ``(S, b, d)`` to ``(S, K)``."""
        log_terms = []
        for pairs in batches(torch.arange(len(theta) * len(row), device=theta.device)):
            sample, k = pairs // len(row), pairs % len(row)
            points, simulated = theta[sample, row[k]], self.simulated[column[k]]
            log_terms.append(log_density(self.density, points, simulated))
        return without_nan(torch.cat(log_terms)).double().reshape(-1, len(row))

    @torch.no_grad()
    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        used, place = row.unique(return_inverse=True)
        column, size = torch.empty_like(row), num_fitting(len(self.simulated))
        for number, some in enumerate(used.split(size)):
            mine = place // size == number
            column[mine] = _chosen(self.rows(z[some]), place[mine] % size)
        return torch.cat(
            [drawn(self.density, self.simulated[k]) for k in batches(column)]
        )

    def mass(self, z: Tensor, num_rows: int, accept: Accept) -> Tensor:
        """Estimate masses row by row, so that they are the same in any batch."""
        estimate = super().mass
        return torch.cat([estimate(one, 1, accept) for one in z.split(1)])


class Coupled(OverSimulations):
    r"""The mixture of RoPE, whose weights are the rows of a coupling.

    .. math:: \sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j}))

    An observation is found by its values. If several in the batch are equal, the row of
    the first is used for all of them.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eq. 5
        | https://arxiv.org/abs/2405.08719

    Args:
        density: :math:`q(\theta \mid s)`.
        x_o: The real observations that were coupled, shape ``(n_o, *event)``.
        coupling: The coupling of :math:`g(x_o)` with :math:`h(x_s)`.
    """

    x_o: Tensor

    def __init__(
        self, density: ConditionalDensityEstimator, x_o: Tensor, coupling: Coupling
    ) -> None:
        super().__init__(density, coupling.simulated.to(x_o), x_o.shape[1:])
        self.coupling = coupling
        self.register_buffer("x_o", x_o)
        # Backwards, so that of equal observations the first is found.
        self._index = {key: i for i, key in reversed([*enumerate(_keys(x_o))])}

    def __getitem__(self, index: int) -> "Coupled":
        """Return the same mixture for one of the observations alone."""
        number = range(len(self.x_o))[index]
        coupling = replace(self.coupling, real=self.coupling.real[number][None])
        return Coupled(self.density, self.x_o[number][None], coupling)

    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of observations of the batch, ``(n, l)``."""
        index = [self._index.get(key, -1) for key in _keys(x.to(self.x_o))]
        if -1 in index:
            raise InvalidInputError(
                f"Expected `x` of the batch that this posterior was built for; got "
                f"{index.count(-1)} others. Couple them with `rope.build_posterior(x)`."
            )
        return self.coupling.real[index]

    def rows(self, z: Tensor) -> Tensor:
        """Return the weights of the simulations, ``(b, n_s)``; rows sum to one."""
        return self.coupling.rows(z)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        # `to` calls this for each module, but a coupling is not a module.
        moved = super()._apply(fn, recurse)
        self.coupling = self.coupling.to(self.x_o.device)
        return moved


def without_tail(weights: Tensor, tail_mass: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return which weights are kept, their columns and logarithms, each ``(b, k)``."""
    # The sum starts at the smallest weights, so that rounding does not lose them.
    ascending, order = weights.sort(dim=1)
    kept = (ascending.cumsum(dim=1, dtype=torch.double) > tail_mass) & (ascending > 0)
    kept[:, -1] = True
    k = int(kept.sum(dim=1).max())
    log_weights = ascending.double().log().where(kept, -torch.inf)
    return kept[:, -k:], order[:, -k:], log_weights[:, -k:]


def _chosen(weights: Tensor, row: Tensor) -> Tensor:
    """Draw a column of the weights ``(b, c)`` for each of n numbers of rows, ``(n,)``.

    The cumulative weights of row i fill the interval [i, i + 1], so that one search
    serves all rows. The offset i costs digits, hence the double precision.
    """
    cumulative = weights.cumsum(dim=1, dtype=torch.double)
    cumulative /= cumulative[:, -1:].clone()
    cumulative += torch.arange(len(weights), device=row.device)[:, None]
    # Below one, so that rounding carries no draw past the last weight of its row.
    uniform = torch.rand(len(row), dtype=torch.double, device=row.device) * (1 - 1e-9)
    # right=True skips columns with a weight of zero.
    found = torch.searchsorted(cumulative.flatten(), uniform + row, right=True)
    return found - row * weights.shape[1]


def _keys(x: Tensor) -> list[bytes]:
    """Return the values of each observation; adding zero turns -0.0 into 0.0."""
    return [row.tobytes() for row in (x.detach().cpu() + 0.0).numpy()]
