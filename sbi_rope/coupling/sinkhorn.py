r"""The solvers of the semi-balanced problem: our own, a fixed point, and POT.

The weight of each real observation is fixed, so the simulation-side log-potential w
determines the whole coupling. Its rows are

.. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma),

and their mean is the column marginal q. The best w minimises the convex dual

.. math::
    F(w) = \frac1{n_o} \sum_i \log \sum_j e^{w_j - C_{ij} / \gamma}
    + \frac{\tau}{1 - \tau} \log \sum_j e^{-w_j (1 - \tau) / \tau},

whose gradient is :math:`q - q^*(w)`. It is the fixed point, up to a constant, of the
Sinkhorn iteration

.. math:: T(w) = \tau (w + \log b - \log q(w)), \qquad b_j = 1 / n_s.

For tau < 1, T is a contraction in the supremum norm with factor tau.
"""

import math
import warnings
from typing import Any, NamedTuple

import ot
import torch
from torch import Tensor

# Entries of a block of rows: they bound the memory of all that is not stored.
BLOCK = 2**20
# The largest number of entries of the kernel to store, 0.4 GB.
MAX_STORED = 50_000_000
# Smaller exponents are raised to this one, because denormal numbers make products ten
# times slower, and columns of zeros have no logarithm.
LOWEST = -660.0
# How far w may move from the potential that a kernel was computed with.
REACH = 200.0
# The last steps that Anderson acceleration combines.
MEMORY = 5
# Keeps the least-squares problem of nearly parallel differences solvable.
RIDGE = 1e-10
# The share of what a plain step gains at least that an accelerated step has to gain,
# up to the rounding of F.
ENOUGH, ROUNDING = 0.5, 1e-14
# Iterations of a call of POT, which computes its kernel at every call.
BURST = 32


def blocks(rows: Tensor, num_columns: int) -> tuple[Tensor, ...]:
    """Cut rows into blocks of a bounded number of entries, at least one row each."""
    return rows.split(max(1, BLOCK // num_columns))


def distances(points: Tensor, others: Tensor) -> Tensor:
    """Return Euclidean distances, ``(n, l)`` and ``(m, l)`` to ``(n, m)``.

    They are computed by a matrix product, relative to the centre of the other points.
    For points at R from it, a distance d has an error of about 1e-16 R^2 / d.
    """
    centre = others.mean(dim=0)
    mode = "use_mm_for_euclid_dist"
    return torch.cdist(points - centre, others - centre, compute_mode=mode)


class Kernel:
    r"""Rows and columns of a potential, by products with an exponentiated matrix.

    The matrix is :math:`e^{w^0_j - C_{ij} / \gamma - m_i}`, where :math:`m_i` makes the
    largest entry of a row one, and :math:`w^0` is the last potential that was absorbed
    into it. For another potential w its columns are multiplied by :math:`e^{w - w^0}`.
    When these factors leave the range of float64, w is absorbed. A large matrix is not
    kept: its blocks are computed for every product.
    """

    def __init__(self, real: Tensor, simulated: Tensor, gamma: float) -> None:
        self.real, self.simulated, self.gamma = real, simulated, gamma
        self._absorbed = simulated.new_full((len(simulated),), math.inf)
        self._is_stored = len(real) * len(simulated) <= MAX_STORED
        self._stored: list[tuple[Tensor, Tensor]] = []

    def __call__(self, potential: Tensor) -> tuple[Tensor, float]:
        """Return log q, shape ``(n_s,)``, and the first term of F."""
        if float((potential - self._absorbed).abs().max()) > REACH:
            self._absorbed = potential
            self._stored = [*self._blocks()] if self._is_stored else []
        scaling = (potential - self._absorbed).exp()
        columns, log_sums = torch.zeros_like(potential), 0.0
        for matrix, shift in self._stored or self._blocks():
            sums = matrix @ scaling
            columns += matrix.T @ sums.reciprocal()
            log_sums += float((sums.log() + shift).sum())
        n_o = len(self.real)
        return potential - self._absorbed + (columns / n_o).log(), log_sums / n_o

    def _blocks(self) -> Any:
        for part in blocks(self.real, len(self.simulated)):
            cost = distances(part, self.simulated)
            exponents = cost.mul_(-1 / self.gamma).add_(self._absorbed)
            shift = exponents.amax(dim=1, keepdim=True)
            yield exponents.sub_(shift).clamp_min_(LOWEST).exp_(), shift[:, 0]


def marginal_error(log_q: Tensor, potential: Tensor, tau: float) -> float:
    r"""Return :math:`\lVert q - q^*(w) \rVert_1`; a constant in w has no effect."""
    target = torch.softmax(-potential * (1.0 - tau) / tau, dim=0)
    return float((log_q.exp() - target).abs().sum())


class Solution(NamedTuple):
    """The best potential, with mean zero, its marginal error, and the iterations."""

    potential: Tensor
    marginal_error: float
    num_iterations: int


def solve(
    kernel: Kernel, *, tau: float, tolerance: float, max_iterations: int
) -> Solution:
    r"""Iterate w to the fixed point, accelerated by Anderson's method.

    The next iterate combines the images T(w) of the last six iterates, with the
    coefficients that make the same combination of the residuals T(w) - w smallest. A
    plain step lowers the dual F by some :math:`\lVert q - q^* \rVert_1^2 / 2` at least.
    If an accelerated step does not lower it by half of that, the plain step is made
    instead, and the memory is cleared.

    References:
        | Anderson Acceleration for Fixed-Point Iterations (Walker and Ni, 2011)
        | https://doi.org/10.1137/10078356X

    Args:
        kernel: The kernel of the two sets of embeddings.
        tau: The trust in the prior, in (0, 1].
        tolerance: The marginal error to reach.
        max_iterations: The largest number of evaluations of the kernel.
    """
    n_s = len(kernel.simulated)
    potential = kernel.real.new_zeros(n_s)
    best, iteration = Solution(potential, math.inf, 0), 0
    images: list[Tensor] = []
    residuals: list[Tensor] = []
    plain, needed = None, math.inf
    for iteration in range(1, max_iterations + 1):
        log_q, dual = kernel(potential)
        if tau < 1.0:
            ratio = (1.0 - tau) / tau
            dual += float((-ratio * potential).logsumexp(dim=0)) / ratio
        error = marginal_error(log_q, potential, tau)
        if error < best.marginal_error:
            best = Solution(potential, error, iteration)
        if error <= tolerance:
            break
        if plain is not None and not dual <= needed:
            potential, plain, images, residuals = plain, None, [], []
            continue
        needed = dual - ENOUGH * error**2 / 2 + ROUNDING * (1 + abs(dual))
        image = tau * (potential - math.log(n_s) - log_q)
        image = image - image.mean()
        images = [*images[-MEMORY:], image]
        residuals = [*residuals[-MEMORY:], image - potential]
        accelerated = _combined(images, residuals) if len(images) > 1 else None
        plain = None if accelerated is None else image
        potential = image if accelerated is None else accelerated
    return best._replace(num_iterations=iteration)


def _combined(images: list[Tensor], residuals: list[Tensor]) -> Tensor | None:
    """Return Anderson's combination of the last images, if it is finite."""
    steps = torch.stack(residuals).diff(dim=0)
    gram = steps @ steps.T
    gram.diagonal().add_(RIDGE * gram.trace())
    coefficients, info = torch.linalg.solve_ex(gram, steps @ residuals[-1])
    combination = images[-1] - coefficients @ torch.stack(images).diff(dim=0)
    is_usable = not info.item() and math.isfinite(float(combination.sum()))
    return combination if is_usable else None


def solve_pot(
    kernel: Kernel, *, tau: float, tolerance: float, max_iterations: int
) -> Solution:
    """Call POT's ``sinkhorn_unbalanced`` until our own marginal error is small enough.

    POT's own error depends on a factor that converges slowest and affects no row. The
    arguments are those of :func:`solve`.
    """
    # A constant added to a row of C does not change the softmax of the row. If the
    # smallest entry of every row is zero, no row of exp(-C / gamma) vanishes.
    scaled = distances(kernel.real, kernel.simulated) / kernel.gamma
    scaled -= scaled.amin(dim=1, keepdim=True)
    n_o, n_s = scaled.shape
    a, b = scaled.new_full((n_o,), 1 / n_o), scaled.new_full((n_s,), 1 / n_s)
    # reg is 1 because the cost is already divided by gamma, and so is rho.
    rho = math.inf if tau == 1.0 else tau / (1.0 - tau)
    best, iterations = Solution(b.new_zeros(n_s), math.inf, 0), 0
    problem: Any = (a, b, scaled, 1.0, (math.inf, rho), "sinkhorn", "kl")
    while iterations < max_iterations:
        count = min(BURST, max_iterations - iterations)
        # POT computes u from v first, so that u may start at zero.
        start = a.new_zeros(n_o), best.potential
        options: Any = {"numItermax": count, "stopThr": 0.0, "warmstart": start}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _, log = ot.unbalanced.sinkhorn_unbalanced(*problem, log=True, **options)
        iterations += count
        potential = log["logv"] - log["logv"].mean()
        if not potential.isfinite().all():  # its scalings over- or underflow
            break
        error = marginal_error(kernel(potential)[0], potential, tau)
        if error >= best.marginal_error:
            break
        best = Solution(potential, error, iterations)
        if error <= tolerance:
            break
    return best._replace(num_iterations=iterations)
