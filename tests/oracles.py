"""Slow, sure computations to test against; independent of the package."""

import math

import torch
from torch import Tensor


def semi_balanced_plan(
    cost: Tensor, *, gamma: float, tau: float, iterations: int = 20_000
) -> tuple[Tensor, float]:
    """Solve for the rows n_o P by two log-domain updates; also the last change.

    With f, g the scaled potentials of the two sides,
    P_ij = exp(f_i + g_j - C_ij / gamma) a_i b_j; the real side is a hard constraint,
    the simulated side a KL penalty with rho / (rho + gamma) = tau.
    """
    cost = cost.double()
    n_o, n_s = cost.shape
    log_b = -math.log(n_s)
    g = torch.zeros(n_s, dtype=torch.float64)
    change = math.inf
    for _ in range(iterations):
        f = -torch.logsumexp(g + log_b - cost / gamma, dim=1)
        new = -tau * torch.logsumexp(f[:, None] - math.log(n_o) - cost / gamma, dim=0)
        # A constant in g is answered by f: only differences are compared.
        change = float(((new - new.mean()) - (g - g.mean())).abs().max())
        g = new
        if change < 1e-14:
            break
    plan = torch.exp(f[:, None] + g + log_b - cost / gamma)
    return plan / plan.sum(dim=1, keepdim=True), change


def objective(plan: Tensor, cost: Tensor, *, gamma: float, tau: float) -> float:
    """Evaluate the paper's eq. 2 at P, rows summing to 1 / n_o."""
    q = plan.sum(dim=0)
    value = (plan * cost).sum() + gamma * torch.xlogy(plan, plan).sum()
    if tau < 1:
        rho = gamma * tau / (1 - tau)
        value = value + rho * torch.xlogy(q, q * len(q)).sum()
    return float(value)
