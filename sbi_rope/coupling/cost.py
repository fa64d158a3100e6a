"""Distances between two sets of embeddings, stored or computed block by block."""

import torch
from torch import Tensor

__all__ = ["Cost", "Distances", "row_blocks"]

# Entries of a block: few enough for the caches of a CPU core, and enough to occupy a
# GPU. Blocks also bound the memory of everything that is not stored.
CPU_BLOCK, GPU_BLOCK = 2**17, 2**24


class Distances:
    r"""Euclidean distances of any points from a fixed set of points.

    They are computed by one matrix product, :math:`\lVert a - b \rVert^2 = \lVert a
    \rVert^2 + \lVert b \rVert^2 - 2 a^\top b`, relative to the centre of the fixed
    points and in float64. For points at R from the centre, a distance d then has an
    error of about 1e-16 R^2 / d, and the distance of equal points one of 1e-8 R. That
    is less than the rounding of a network's embeddings in float32. Where it is not
    enough, ``direct`` sums squared differences, which takes 1.4 times as long in ten
    dimensions and 7 times as long in 64.

    Args:
        points: The fixed points, shape ``(n_s, l)``; the distances have their dtype.
        direct: Whether to avoid the matrix product.
    """

    def __init__(self, points: Tensor, *, direct: bool = False) -> None:
        # The median, because a single far point must not move the centre.
        self.centre = points.double().median(dim=0).values
        self.direct = direct
        self._centred = points.double() - self.centre
        self._dtype = points.dtype
        squares = self._centred.square().sum(dim=1, keepdim=True)
        self._largest_norm = self._centred.norm(dim=1).max()
        # Their product with rows (-2a, |a|^2, 1) is the squared distance.
        columns = [self._centred, torch.ones_like(squares), squares]
        self._factor = torch.cat(columns, dim=1).T

    def __call__(self, points: Tensor, columns: Tensor | None = None) -> Tensor:
        """Return the distances of points ``(n, l)`` from all or some fixed points."""
        centred = points.double() - self.centre
        if self.direct:
            fixed = self._centred if columns is None else self._centred[columns]
            mode = "donot_use_mm_for_euclid_dist"
            return torch.cdist(centred, fixed, compute_mode=mode).to(self._dtype)
        squares = centred.square().sum(dim=1, keepdim=True)
        rows = torch.cat([-2 * centred, squares, torch.ones_like(squares)], dim=1)
        factor = self._factor if columns is None else self._factor[:, columns]
        return (rows @ factor).clamp_min_(0).sqrt_().to(self._dtype)

    def bound(self, points: Tensor) -> float:
        """Return an upper bound of the distances of these points."""
        largest = (points.double() - self.centre).norm(dim=1).max()
        return float(self._largest_norm + largest)


class Cost:
    r""":math:`C_{ij} = \lVert g(x_{o,i}) - h(x_{s,j}) \rVert_2`.

    Args:
        real: :math:`g(x_o)`, shape ``(n_o, l)``.
        simulated: :math:`h(x_s)`, shape ``(n_s, l)``.
        stored: Whether to keep the matrix, or compute its blocks at every request.
        direct: Whether to compute distances without a matrix product.

    Attributes:
        bound: An upper bound of the distances.
    """

    def __init__(
        self, real: Tensor, simulated: Tensor, *, stored: bool, direct: bool = False
    ) -> None:
        self.real = real
        self.simulated = simulated
        self._distances = Distances(simulated, direct=direct)
        self.bound = self._distances.bound(real)
        self.matrix: Tensor | None = None
        if stored:
            self.matrix = real.new_empty(self.shape)
            for rows in self.row_blocks():
                self.matrix[rows] = self._distances(real[rows])

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of observations and of simulations."""
        return len(self.real), len(self.simulated)

    def block(self, rows: slice, columns: Tensor | None = None) -> Tensor:
        """Return some rows, or some columns of these; do not write to them."""
        if self.matrix is None:
            return self._distances(self.real[rows], columns)
        return self.matrix[rows] if columns is None else self.matrix[rows, columns]

    def row_blocks(
        self, num_columns: int | None = None, *, scale: int = 1
    ) -> list[slice]:
        """Cut the rows into blocks, ``scale`` times as large as usual."""
        return row_blocks(self.real, num_columns or len(self.simulated), scale=scale)


def row_blocks(real: Tensor, num_columns: int, *, scale: int = 1) -> list[slice]:
    """Cut rows into blocks of a bounded number of entries, at least one row each."""
    limit = CPU_BLOCK if real.device.type == "cpu" else GPU_BLOCK
    size = max(1, scale * limit // num_columns)
    return [slice(first, first + size) for first in range(0, len(real), size)]
