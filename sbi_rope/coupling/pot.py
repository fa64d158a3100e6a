"""The same problem, solved by POT."""

import math
import warnings

import ot
from torch import Tensor

from sbi_rope.coupling.cost import Cost
from sbi_rope.coupling.fixed_point import Solution
from sbi_rope.coupling.kernel import Kernel, marginal_error

__all__ = ["solve_pot"]

# Iterations of the first call of POT, and the most of any call. POT rebuilds its kernel
# at every call, which costs about ten iterations.
FIRST_BURST, LAST_BURST = 16, 256


def solve_pot(
    cost: Cost,
    gamma: float,
    kernel: Kernel,
    start: Tensor,
    *,
    tau: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[Solution, bool]:
    """Call POT's ``sinkhorn_unbalanced`` until our own marginal error is small enough.

    POT's own stopping rule looks at the scalings u and v. Their common factor does not
    affect the rows, but converges slowest. Our error does not depend on it.

    Args:
        cost: The distances, stored.
        gamma: The entropic regularisation, in units of the cost.
        kernel: Returns log q of a potential.
        start: The first potential, shape ``(n_s,)``.
        tau: The trust in the prior, in (0, 1].
        tolerance: The marginal error to reach.
        max_iterations: The largest number of iterations, over all calls.

    Returns:
        The best solution, and whether POT's numbers stayed usable. If they did not,
        another solver has to go on.
    """
    n_o, n_s = cost.shape
    # A constant added to a row of C does not change the softmax of the row. If the
    # smallest entry of every row is zero, no row of exp(-C / gamma) vanishes.
    scaled = cost.block(slice(None)) / gamma
    scaled -= scaled.amin(dim=1, keepdim=True)
    a, b = scaled.new_full((n_o,), 1 / n_o), scaled.new_full((n_s,), 1 / n_s)
    # reg is 1 because the cost is already divided by gamma, and so is rho.
    rho = math.inf if tau == 1.0 else tau / (1.0 - tau)
    potential = start - start.mean()
    best = Solution(potential, math.inf, 0)
    iterations, burst = 0, FIRST_BURST
    while iterations < max_iterations:
        burst = min(burst, max_iterations - iterations)
        with warnings.catch_warnings():
            # POT's warnings are not needed: its results are checked below.
            warnings.simplefilter("ignore")
            _, log = ot.unbalanced.sinkhorn_unbalanced(
                a,
                b,
                scaled,
                reg=1.0,
                reg_m=(math.inf, rho),
                method="sinkhorn",
                reg_type="kl",
                # POT computes u from v first, so that u may start at zero.
                warmstart=(scaled.new_zeros(n_o), potential),
                numItermax=burst,
                stopThr=0.0,
                log=True,
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
