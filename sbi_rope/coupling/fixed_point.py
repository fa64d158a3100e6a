r"""Our own solver of the semi-balanced problem: an accelerated fixed point.

The weight of each real observation is fixed, so the simulation-side log-potential w
determines the whole coupling. The best w is the fixed point of

.. math:: T(w) = \tau (w + \log b - \log q(w)),

up to a constant, which changes no row. T is the Sinkhorn iteration of the problem. For
tau < 1 it is a contraction in the supremum norm with factor tau.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.coupling.kernel import marginal_error

__all__ = ["Solution", "solve_fixed_point"]

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


class Solution(NamedTuple):
    """A potential, its marginal error, and the iterations it took."""

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

    Returns:
        The potential with the smallest error, shifted to mean zero, its error, and the
        number of evaluations.
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
        self._history = _History(start)
        self._best_error = self._last_error = math.inf
        self._without_progress = 0
        self._plain_left, self._pause = 0, FIRST_PAUSE
        # Where to go if the last, accelerated step proves bad; None after a plain step.
        self._instead: Tensor | None = None
        # Where to go if acceleration makes no progress.
        self._anchor = start

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
        accelerated = self._history.combine(potential, image)
        self._instead = None if accelerated is None else image
        return image if accelerated is None else accelerated

    def _forget(self, plain: Tensor) -> Tensor:
        self._history.clear()
        self._instead = None
        return plain


class _History:
    """The last iterates and residuals, and Anderson's combination of them."""

    def __init__(self, like: Tensor) -> None:
        # Differences of images and of residuals. The oldest are overwritten first.
        self._image_steps = like.new_zeros(MEMORY, len(like))
        self._residual_steps = like.new_zeros(MEMORY, len(like))
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._num_steps = 0
        self._last: tuple[Tensor, Tensor] | None = None

    def combine(self, potential: Tensor, image: Tensor) -> Tensor | None:
        """Add an iterate and its image; return the next iterate, or None."""
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
