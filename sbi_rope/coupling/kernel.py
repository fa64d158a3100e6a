r"""The column marginal of a potential, by products with an exponentiated matrix.

For a simulation-side log-potential :math:`w` the rows of the coupling are

.. math:: \alpha_{ij} = \frac{\kappa_{ij}}{\sum_k \kappa_{ik}}, \qquad
    \kappa_{ij} = e^{w_j - C_{ij} / \gamma - m_i},

with any :math:`m_i`. The mean of the rows is the column marginal :math:`q`.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost

__all__ = ["Kernel", "marginal_error"]


class _Range(NamedTuple):
    """The exponents that a dtype can hold."""

    # Smaller exponents are raised to this one, because denormal numbers make products
    # ten times slower.
    lowest: float
    # If no exponent is larger than this, neither a shift nor a floor is needed.
    free: float
    # How far w may move from the potential that a kernel was computed with.
    reach: float


RANGE = {
    torch.float32: _Range(lowest=-69.0, free=45.0, reach=20.0),
    torch.float64: _Range(lowest=-660.0, free=450.0, reach=200.0),
}

# Products of stored blocks need no memory for intermediate results, so that larger
# blocks are faster.
STORED_BLOCK = 8


class Kernel:
    r"""The column marginal of a potential, by products with an exponentiated matrix.

    The matrix is :math:`e^{w^0_j - C_{ij} / \gamma - m_i}`, where :math:`w^0` is the
    last potential that was absorbed into it. For another potential w its columns are
    multiplied by :math:`e^{w - w^0}`. When these factors leave the range of the dtype,
    w is absorbed.

    Args:
        cost: The distances.
        gamma: The entropic regularisation, in units of the cost.
        stored: Whether to keep the matrix, or compute its blocks for every product.

    Attributes:
        num_absorptions: How often a potential was absorbed so far.
    """

    def __init__(self, cost: Cost, gamma: float, *, stored: bool) -> None:
        self.cost = cost
        self.gamma = gamma
        self.num_absorptions = 0
        self._dtype = cost.real.dtype
        self._matrix = cost.real.new_empty(cost.shape) if stored else None
        self._shift = cost.real.new_zeros(len(cost.real))
        self._absorbed: Tensor | None = None
        self._exact = True

    def __call__(self, potential: Tensor) -> Tensor:
        """Return log q of a potential, both of shape ``(n_s,)``.

        Both are in float64, or in float32 on a device without it.
        """
        absorbed = self._absorbed
        reach = RANGE[self._dtype].reach
        if absorbed is None or float((potential - absorbed).abs().max()) > reach:
            absorbed = self._absorb(potential)
        scaling = (potential - absorbed).exp()
        row_sums, columns = self._products(scaling.to(self._dtype))
        log_q = (scaling * columns / len(row_sums)).log()
        if not self._exact:
            lost = _lost(columns, row_sums)
            row_log_sums = self._shift + row_sums.log()
            self._restore(log_q, lost, potential, row_log_sums)
        return log_q

    def _absorb(self, potential: Tensor) -> Tensor:
        self.num_absorptions += 1
        # The absorbed potential is rounded to the dtype of the matrix.
        w = potential.to(self._dtype)
        self._absorbed = w.to(potential.dtype)
        spread = float(w.abs().max()) + self.cost.bound / self.gamma
        self._exact = spread <= RANGE[self._dtype].free
        if self._matrix is not None:
            for rows in self.cost.row_blocks():
                self._exponentials(rows, w, out=self._matrix[rows])
        return self._absorbed

    def _exponentials(
        self, rows: slice, w: Tensor, out: Tensor | None = None
    ) -> Tensor:
        """Compute some rows of the matrix, and their shifts."""
        cost = self.cost.block(rows)
        block = torch.add(w, cost, alpha=-1 / self.gamma, out=out)
        if self._exact:
            return block.exp_()
        shift = self._shift[rows] = block.amax(dim=1)
        lowest = RANGE[self._dtype].lowest
        return block.sub_(shift[:, None]).clamp_min_(lowest).exp_()

    def _products(self, scaling: Tensor) -> tuple[Tensor, Tensor]:
        """Return K v, and the product of K^T with its reciprocal in the dtype of w."""
        assert self._absorbed is not None
        w = self._absorbed.to(self._dtype)
        row_sums = self._shift.new_empty(len(self._shift))
        columns = torch.zeros_like(self._absorbed)
        # Each block is used twice while it is in the cache. Adding up the blocks in
        # float64 keeps the rounding errors of float32 small for any number of rows.
        scale = 1 if self._matrix is None else STORED_BLOCK
        for rows in self.cost.row_blocks(scale=scale):
            matrix = self._matrix
            block = self._exponentials(rows, w) if matrix is None else matrix[rows]
            sums = torch.mv(block, scaling, out=row_sums[rows])
            columns += block.T @ sums.reciprocal()
        return row_sums, columns

    def _restore(
        self, log_q: Tensor, lost: Tensor, potential: Tensor, row_log_sums: Tensor
    ) -> None:
        """Replace columns that the matrix cannot hold by log-sum-exps."""
        index = lost.nonzero().flatten()
        if not len(index):
            return
        w = potential[index].to(self._dtype)
        total = torch.full_like(w, -math.inf)
        for rows in self.cost.row_blocks(len(index)):
            exponents = w - self.cost.block(rows, index) / self.gamma
            exponents -= row_log_sums[rows, None]
            total = torch.logaddexp(total, torch.logsumexp(exponents, dim=0))
        log_q[index] = total.to(log_q.dtype) - math.log(len(row_log_sums))


def marginal_error(log_q: Tensor, potential: Tensor, tau: float) -> float:
    r"""Return :math:`\lVert q - q^*(w) \rVert_1`; a constant in w has no effect."""
    if tau == 0.0:
        return 0.0  # the column marginal has to fulfil no condition
    target = torch.softmax(-potential * (1.0 - tau) / tau, dim=0)
    return float((log_q.exp() - target).abs().sum())


def _lost(columns: Tensor, row_sums: Tensor) -> Tensor:
    """Tell in which columns the entries that were raised to the floor may matter."""
    eps = torch.finfo(row_sums.dtype).eps
    floor = math.exp(RANGE[row_sums.dtype].lowest)
    return floor * float(row_sums.to(columns.dtype).reciprocal().sum()) > eps * columns
