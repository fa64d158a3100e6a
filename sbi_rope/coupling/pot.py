"""The same problem handed to POT."""

import math
import warnings

import ot
from torch import Tensor

from sbi_rope.coupling.cost import Cost
from sbi_rope.coupling.fixed_point import Solution
from sbi_rope.coupling.kernel import Kernel, marginal_error

__all__ = ["solve_pot"]

# POT rebuilds its kernel at every call, which costs about ten iterations.
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
    """Run POT's ``sinkhorn_unbalanced`` in bursts until our own error is met.

    POT's own stopping rule watches the scalings u and v, whose common factor does not
    affect the rows and converges slowest. Ours sees only what matters.

    Returns:
        The best solution seen, and whether POT remained healthy: False asks another
        solver for help.
    """
    n_o, n_s = cost.shape
    # A constant added to a row of C changes no softmax of it. With the smallest entry
    # of every row at zero the kernel exp(-C / gamma) cannot vanish in a row.
    scaled = cost.block(slice(None)) / gamma
    scaled -= scaled.amin(dim=1, keepdim=True)
    a, b = scaled.new_full((n_o,), 1 / n_o), scaled.new_full((n_s,), 1 / n_s)
    # reg is 1 because the cost is already divided by gamma; rho is in its units.
    rho = math.inf if tau == 1.0 else tau / (1.0 - tau)
    potential = start - start.mean()
    best = Solution(potential, math.inf, 0)
    iterations, burst = 0, FIRST_BURST
    while iterations < max_iterations:
        burst = min(burst, max_iterations - iterations)
        with warnings.catch_warnings():
            # What POT warns of is caught below, by looking at what it returned.
            warnings.simplefilter("ignore")
            _, log = ot.unbalanced.sinkhorn_unbalanced(
                a,
                b,
                scaled,
                reg=1.0,
                reg_m=(math.inf, rho),
                method="sinkhorn",
                reg_type="kl",
                # POT computes u from v first; only the mean of v is free.
                warmstart=(scaled.new_zeros(n_o), potential.to(scaled)),
                numItermax=burst,
                stopThr=0.0,
                log=True,
            )
        done = len(log["err"])
        iterations += done
        if not (log["logu"].isfinite().all() and log["logv"].isfinite().all()):
            return best._replace(num_iterations=iterations), False
        potential = log["logv"].to(start.dtype)
        potential = potential - potential.mean()
        error = marginal_error(kernel(potential), potential, tau)
        # If the error stays, POT has lost entries of the kernel to underflow, or the
        # problem is one where iterations hardly help. If POT made fewer iterations
        # than asked, it met infinities.
        healthy = done == burst and error < 0.999 * best.marginal_error
        if error < best.marginal_error:
            best = Solution(potential, error, iterations)
        if error <= tolerance:
            return best, True
        if not healthy:
            break
        burst = min(2 * burst, LAST_BURST)
    return best._replace(num_iterations=iterations), iterations >= max_iterations
