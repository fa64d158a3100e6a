r"""The column marginal of a potential, by products with an exponentiated matrix.

For a simulation-side log-potential :math:`w` the rows of the coupling are

.. math:: \alpha_{ij} = \frac{\kappa_{ij}}{\sum_k \kappa_{ik}}, \qquad
    \kappa_{ij} = e^{w_j - C_{ij} / \gamma - m_i},

with any :math:`m_i`. The mean of the rows is the column marginal :math:`q`.
"""

import math

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost

__all__ = ["Kernel", "marginal_error"]


# Smaller exponents are raised to this one, because denormal numbers make products ten
# times slower.
LOWEST = -660.0
# If no exponent is larger than this, neither a shift nor a floor is needed.
FREE = 450.0
# How far w may move from the potential that a kernel was computed with.
REACH = 200.0
# Products of stored blocks need no memory for intermediate results, so that larger
# blocks are faster.
STORED_BLOCK = 8


class Kernel:
    r"""The column marginal of a potential, by products with an exponentiated matrix.

    The matrix is :math:`e^{w^0_j - C_{ij} / \gamma - m_i}`, where :math:`w^0` is the
    last potential that was absorbed into it. For another potential w its columns are
    multiplied by :math:`e^{w - w^0}`. When these factors leave the range of float64, w
    is absorbed.

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
        self._matrix = cost.real.new_empty(cost.shape) if stored else None
        self._shift = cost.real.new_zeros(len(cost.real))
        self._absorbed: Tensor | None = None
        self._exact = True

    def __call__(self, potential: Tensor) -> Tensor:
        """Return log q of a potential, both of shape ``(n_s,)``."""
        absorbed = self._absorbed
        if absorbed is None or float((potential - absorbed).abs().max()) > REACH:
            absorbed = self._absorb(potential)
        scaling = (potential - absorbed).exp()
        row_sums, columns = self._products(scaling)
        log_q = (scaling * columns / len(row_sums)).log()
        if not self._exact:
            lost = _lost(columns, row_sums)
            row_log_sums = self._shift + row_sums.log()
            self._restore(log_q, lost, potential, row_log_sums)
        return log_q

    def _absorb(self, potential: Tensor) -> Tensor:
        self.num_absorptions += 1
        self._absorbed = potential
        spread = float(potential.abs().max()) + self.cost.bound / self.gamma
        self._exact = spread <= FREE
        if self._matrix is not None:
            for rows in self.cost.row_blocks():
                self._exponentials(rows, potential, out=self._matrix[rows])
        return potential

    def _exponentials(
        self, rows: slice, w: Tensor, out: Tensor | None = None
    ) -> Tensor:
        """Compute some rows of the matrix, and their shifts."""
        cost = self.cost.block(rows)
        block = torch.add(w, cost, alpha=-1 / self.gamma, out=out)
        if self._exact:
            return block.exp_()
        shift = self._shift[rows] = block.amax(dim=1)
        return block.sub_(shift[:, None]).clamp_min_(LOWEST).exp_()

    def _products(self, scaling: Tensor) -> tuple[Tensor, Tensor]:
        """Return K v, and the product of K^T with its reciprocal."""
        assert self._absorbed is not None
        row_sums = self._shift.new_empty(len(self._shift))
        columns = torch.zeros_like(self._absorbed)
        # Each block is used twice while it is in the cache.
        scale = 1 if self._matrix is None else STORED_BLOCK
        for rows in self.cost.row_blocks(scale=scale):
            matrix = self._matrix
            if matrix is None:
                block = self._exponentials(rows, self._absorbed)
            else:
                block = matrix[rows]
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
        w = potential[index]
        total = torch.full_like(w, -math.inf)
        for rows in self.cost.row_blocks(len(index)):
            exponents = w - self.cost.block(rows, index) / self.gamma
            exponents -= row_log_sums[rows, None]
            total = torch.logaddexp(total, torch.logsumexp(exponents, dim=0))
        log_q[index] = total - math.log(len(row_log_sums))


def marginal_error(log_q: Tensor, potential: Tensor, tau: float) -> float:
    r"""Return :math:`\lVert q - q^*(w) \rVert_1`; a constant in w has no effect."""
    if tau == 0.0:
        return 0.0  # the column marginal has to fulfil no condition
    target = torch.softmax(-potential * (1.0 - tau) / tau, dim=0)
    return float((log_q.exp() - target).abs().sum())


def _lost(columns: Tensor, row_sums: Tensor) -> Tensor:
    """Tell in which columns the entries that were raised to the floor may matter."""
    eps = torch.finfo(row_sums.dtype).eps
    return math.exp(LOWEST) * float(row_sums.reciprocal().sum()) > eps * columns
