r"""The solvers of the semi-balanced problem: our own, a fixed point, and POT.

The weight of each real observation is fixed, so the simulation-side log-potential w
determines the whole coupling. Its rows are

.. math:: \alpha_{ij} = \frac{\kappa_{ij}}{\sum_k \kappa_{ik}}, \qquad
    \kappa_{ij} = e^{w_j - C_{ij} / \gamma - m_i},

with any :math:`m_i`, and their mean is the column marginal q. The best w is the fixed
point of

.. math:: T(w) = \tau (w + \log b - \log q(w)),

up to a constant, which changes no row. T is the Sinkhorn iteration of the problem. For
tau < 1 it is a contraction in the supremum norm with factor tau.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import ot
import torch
from torch import Tensor

# Entries of a block: few enough for the caches of a CPU core, and enough to occupy a
# GPU. Blocks also bound the memory of everything that is not stored.
CPU_BLOCK, GPU_BLOCK = 2**17, 2**24
# Products of stored blocks need no memory for intermediate results, so that larger
# blocks are faster.
STORED_BLOCK = 8
# Smaller exponents are raised to this one, because denormal numbers make products ten
# times slower.
LOWEST = -660.0
# If no exponent is larger than this, neither a shift nor a floor is needed.
FREE = 450.0
# How far w may move from the potential that a kernel was computed with.
REACH = 200.0
# The last steps that Anderson acceleration combines.
MEMORY = 5
# An accelerated step is taken back if its error exceeds the last one by this factor.
LARGEST_GROWTH = 2.0
# After PATIENCE accelerated steps without a new best error, plain steps are made
# instead: FIRST_PAUSE of them the first time.
PATIENCE, FIRST_PAUSE = 100, 50
# Keeps the least-squares problem of nearly parallel differences solvable.
RIDGE = 1e-10
# The digits are exhausted after STALLED iterations without a new best error, if the
# error is below 100 rounding errors.
STALLED, EXHAUSTED = 500, 100.0 * torch.finfo(torch.float64).eps
# Iterations of the first call of POT, and the most of any call. POT rebuilds its kernel
# at every call, which costs about ten iterations.
FIRST_BURST, LAST_BURST = 16, 256


def row_blocks(rows: Tensor, num_columns: int, *, scale: int = 1) -> list[slice]:
    """Cut rows into blocks of a bounded number of entries, at least one row each."""
    limit = CPU_BLOCK if rows.device.type == "cpu" else GPU_BLOCK
    size = max(1, scale * limit // num_columns)
    return [slice(first, first + size) for first in range(0, len(rows), size)]


class Distances:
    r"""Euclidean distances of any points from a fixed set of points.

    They are computed by one matrix product, :math:`\lVert a - b \rVert^2 = \lVert a
    \rVert^2 + \lVert b \rVert^2 - 2 a^\top b`, relative to the centre of the fixed
    points and in float64. For points at R from the centre, a distance d then has an
    error of about 1e-16 R^2 / d, and the distance of equal points one of 1e-8 R. Where
    that is not enough, ``direct`` sums squared differences, which takes longer.

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

    def __len__(self) -> int:
        return len(self._centred)

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


class Kernel:
    r"""The column marginal of a potential, by products with an exponentiated matrix.

    The matrix is :math:`e^{w^0_j - C_{ij} / \gamma - m_i}`, where :math:`w^0` is the
    last potential that was absorbed into it. For another potential w its columns are
    multiplied by :math:`e^{w - w^0}`. When these factors leave the range of float64, w
    is absorbed.

    Args:
        real: The embeddings of observations, shape ``(n_o, l)``.
        distances: Their distances C from the simulations.
        gamma: The entropic regularisation, in units of the distances.
        stored: Whether to keep the matrix, or compute its blocks for every product.
    """

    def __init__(
        self, real: Tensor, distances: Distances, gamma: float, *, stored: bool
    ) -> None:
        self.real, self.distances, self.gamma = real, distances, gamma
        self._bound = distances.bound(real)
        shape = len(real), len(distances)
        self._matrix = real.new_empty(shape) if stored else None
        self._shift = real.new_zeros(len(real))
        self._absorbed: Tensor | None = None
        self._exact = True

    def __call__(self, potential: Tensor) -> Tensor:
        """Return log q of a potential, both of shape ``(n_s,)``."""
        absorbed = self._absorbed
        if absorbed is None or float((potential - absorbed).abs().max()) > REACH:
            absorbed = self._absorb(potential)
        scaling = (potential - absorbed).exp()
        row_sums = self._shift.new_empty(len(self._shift))
        columns = torch.zeros_like(absorbed)
        # Each block is used twice while it is in the cache.
        matrix, scale = self._matrix, 1 if self._matrix is None else STORED_BLOCK
        for rows in row_blocks(self.real, len(potential), scale=scale):
            block = (
                self._exponentials(rows, absorbed) if matrix is None else matrix[rows]
            )
            sums = torch.mv(block, scaling, out=row_sums[rows])
            columns += block.T @ sums.reciprocal()
        log_q = (scaling * columns / len(row_sums)).log()
        if not self._exact:
            self._restore(log_q, columns, potential, row_sums)
        return log_q

    def _absorb(self, potential: Tensor) -> Tensor:
        self._absorbed = potential
        self._exact = float(potential.abs().max()) + self._bound / self.gamma <= FREE
        if self._matrix is not None:
            for rows in row_blocks(self.real, len(potential)):
                self._exponentials(rows, potential, out=self._matrix[rows])
        return potential

    def _exponentials(
        self, rows: slice, w: Tensor, out: Tensor | None = None
    ) -> Tensor:
        """Compute some rows of the matrix, and their shifts."""
        cost = self.distances(self.real[rows])
        block = torch.add(w, cost, alpha=-1 / self.gamma, out=out)
        if self._exact:
            return block.exp_()
        shift = self._shift[rows] = block.amax(dim=1)
        return block.sub_(shift[:, None]).clamp_min_(LOWEST).exp_()

    def _restore(
        self, log_q: Tensor, columns: Tensor, potential: Tensor, row_sums: Tensor
    ) -> None:
        """Replace columns in which entries at the floor may matter by log-sum-exps."""
        eps = torch.finfo(row_sums.dtype).eps
        lost = math.exp(LOWEST) * float(row_sums.reciprocal().sum()) > eps * columns
        index = lost.nonzero().flatten()
        if not len(index):
            return
        row_log_sums = self._shift + row_sums.log()
        w = potential[index]
        total = torch.full_like(w, -math.inf)
        for rows in row_blocks(self.real, len(index)):
            exponents = w - self.distances(self.real[rows], index) / self.gamma
            exponents -= row_log_sums[rows, None]
            total = torch.logaddexp(total, torch.logsumexp(exponents, dim=0))
        log_q[index] = total - math.log(len(row_log_sums))


def marginal_error(log_q: Tensor, potential: Tensor, tau: float) -> float:
    r"""Return :math:`\lVert q - q^*(w) \rVert_1`; a constant in w has no effect."""
    if tau == 0.0:
        return 0.0  # the column marginal has to fulfil no condition
    target = torch.softmax(-potential * (1.0 - tau) / tau, dim=0)
    return float((log_q.exp() - target).abs().sum())


class Solution(NamedTuple):
    """The best potential, with mean zero, its marginal error, and the iterations."""

    potential: Tensor
    marginal_error: float
    num_iterations: int


def solve_fixed_point(
    kernel: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    tau: float,
    tolerance: float,
    max_iterations: int,
) -> Solution:
    r"""Iterate w to the fixed point, accelerated by Anderson's method.

    The next iterate combines the images T(w) of the last six iterates, with
    the coefficients that make the same combination of the residuals T(w) - w smallest.
    If that makes the marginal error grow, the plain step T(w) is made instead, and the
    memory is cleared. If it makes no progress for long, the plain iteration takes over
    for a while.

    Args:
        kernel: Returns log q of a potential.
        start: The first potential, shape ``(n_s,)``.
        tau: The trust in the prior, in (0, 1].
        tolerance: The marginal error to reach.
        max_iterations: The largest number of evaluations of the kernel.
    """
    log_b = -math.log(len(start))
    potential = start - start.mean()
    best, best_at, iteration = Solution(potential, math.inf, 0), 0, 0
    steps = _Steps(potential)
    for iteration in range(1, max_iterations + 1):
        log_q = kernel(potential)
        error = marginal_error(log_q, potential, tau)
        if error < best.marginal_error:
            best, best_at = Solution(potential, error, iteration), iteration
        exhausted = iteration - best_at > STALLED and error < EXHAUSTED
        if error <= tolerance or exhausted:
            break
        image = tau * (potential + log_b - log_q)
        image = image - image.mean()
        potential = steps.next(potential, image, error)
    return best._replace(num_iterations=iteration)


class _Steps:
    """Accelerated steps, and plain steps where acceleration does not help."""

    def __init__(self, start: Tensor) -> None:
        # Differences of images and of residuals. The oldest are overwritten first.
        self._image_steps = start.new_zeros(MEMORY, len(start))
        self._residual_steps = start.new_zeros(MEMORY, len(start))
        self._best_error = self._last_error = math.inf
        self._without_progress = 0
        self._plain_left, self._pause = 0, FIRST_PAUSE
        # Where to go if acceleration makes no progress.
        self._anchor = start
        self._forget(start)

    def next(self, potential: Tensor, image: Tensor, error: float) -> Tensor:
        """Return the next potential after one with this image and error."""
        self._without_progress += 1
        # Plain steps may have to move the potential far before the error falls. The end
        # of a phase of plain steps therefore counts as progress, too.
        if error < self._best_error or self._plain_left == 1:
            self._best_error = min(error, self._best_error)
            self._without_progress, self._anchor = 0, image
        if self._plain_left:
            self._plain_left -= 1
            return image
        if self._without_progress > PATIENCE:
            self._plain_left, self._pause = self._pause, 2 * self._pause
            return self._forget(self._anchor)
        if self._instead is not None and not error <= LARGEST_GROWTH * self._last_error:
            return self._forget(self._instead)
        self._last_error = error
        accelerated = self._combined(potential, image)
        self._instead = None if accelerated is None else image
        return image if accelerated is None else accelerated

    def _forget(self, plain: Tensor) -> Tensor:
        """Forget the last steps, and go where a plain step leads."""
        self._num_steps = 0
        self._last: tuple[Tensor, Tensor] | None = None
        # Where to go if the last, accelerated step proves bad; None after a plain step.
        self._instead: Tensor | None = None
        return plain

    def _combined(self, potential: Tensor, image: Tensor) -> Tensor | None:
        """Return Anderson's combination of the last images, if there is one."""
        residual = image - potential
        if self._last is not None:
            slot = self._num_steps % MEMORY
            torch.sub(image, self._last[0], out=self._image_steps[slot])
            torch.sub(residual, self._last[1], out=self._residual_steps[slot])
            self._num_steps += 1
        self._last = (image, residual)
        if not self._num_steps:
            return None
        steps = self._residual_steps[: self._num_steps]
        gram = steps @ steps.T
        gram.diagonal().add_(RIDGE * gram.trace())
        coefficients, info = torch.linalg.solve_ex(gram, steps @ residual)
        combination = image - coefficients @ self._image_steps[: self._num_steps]
        if info.item() or not math.isfinite(float(combination.sum())):
            return None
        return combination


# --- the same problem, solved by POT ---


def solve_pot(
    kernel: Kernel, start: Tensor, *, tau: float, tolerance: float, max_iterations: int
) -> tuple[Solution, bool]:
    """Call POT's ``sinkhorn_unbalanced`` until our own marginal error is small enough.

    POT's own error depends on a factor that converges slowest and affects no row. The
    arguments are those of :func:`solve_fixed_point`. Return the best solution, and
    whether POT's numbers stayed usable.
    """
    # A constant added to a row of C does not change the softmax of the row. If the
    # smallest entry of every row is zero, no row of exp(-C / gamma) vanishes.
    scaled = kernel.distances(kernel.real) / kernel.gamma
    scaled -= scaled.amin(dim=1, keepdim=True)
    n_o, n_s = scaled.shape
    a, b = scaled.new_full((n_o,), 1 / n_o), scaled.new_full((n_s,), 1 / n_s)
    # reg is 1 because the cost is already divided by gamma, and so is rho.
    rho = math.inf if tau == 1.0 else tau / (1.0 - tau)
    potential = start - start.mean()
    best = Solution(potential, math.inf, 0)
    iterations, burst = 0, FIRST_BURST
    while iterations < max_iterations:
        burst = min(burst, max_iterations - iterations)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            options: Any = {"numItermax": burst, "stopThr": 0.0, "log": True}
            # POT computes u from v first, so that u may start at zero.
            options["warmstart"] = (scaled.new_zeros(n_o), potential)
            _, log = ot.unbalanced.sinkhorn_unbalanced(
                a, b, scaled, 1.0, (math.inf, rho), "sinkhorn", "kl", **options
            )
        done = len(log["err"])
        iterations += done
        if not (log["logu"].isfinite().all() and log["logv"].isfinite().all()):
            return best._replace(num_iterations=iterations), False
        potential = log["logv"] - log["logv"].mean()
        error = marginal_error(kernel(potential), potential, tau)
        # If the error does not fall, POT has lost entries of the kernel to underflow,
        # or iterations hardly help in this problem. If POT stopped before the end, it
        # met infinite numbers.
        healthy = done == burst and error < 0.999 * best.marginal_error
        if error < best.marginal_error:
            best = Solution(potential, error, iterations)
        if error <= tolerance:
            return best, True
        if not healthy:
            break
        burst = min(2 * burst, LAST_BURST)
    return best._replace(num_iterations=iterations), iterations >= max_iterations
