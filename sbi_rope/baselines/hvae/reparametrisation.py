r"""Draws from a flow whose gradient reaches its condition."""

from typing import Any

import torch
from torch import Tensor

__all__ = ["reparametrised_sample"]


def reparametrised_sample(flow: Any, condition: Tensor) -> Tensor:
    r"""Draw one theta a condition, differentiable with respect to the condition.

    A flow maps theta to noise :math:`u = T(\theta; s)`. At fixed noise the theorem on
    implicit functions gives

    .. math::
        \frac{\partial \theta}{\partial s} = -\left(
        \frac{\partial T}{\partial \theta} \right)^{-1} \frac{\partial T}{\partial s}.

    Only :math:`T` is differentiated, in the direction in which densities are evaluated.
    So the gradient is the same for flows that are inverted in closed form, one
    parameter after the other, or by a search that has no gradient.

    Args:
        flow: A flow of sbi without embedding net.
        condition: Its conditions s, shape ``(n, l)``.

    Returns:
        Parameters, shape ``(n, d)``.
    """
    with torch.no_grad():
        theta = flow.sample(torch.Size((1,)), condition)[0]
    if not torch.is_grad_enabled():
        return theta
    point = theta.detach().requires_grad_()
    noise = flow.inverse_transform(point, condition)
    rows = [
        torch.autograd.grad(entry.sum(), point, retain_graph=True)[0]
        for entry in noise.unbind(dim=1)
    ]
    jacobian = torch.stack(rows, dim=1)
    # Zero, but for its gradient.
    step = torch.linalg.solve(jacobian, (noise - noise.detach()).unsqueeze(2))
    return theta - step.squeeze(2)
