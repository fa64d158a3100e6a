"""Velocity fields that carry one distribution to another, and how they are followed."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["NUM_STEPS", "VelocityField", "follow", "follow_back", "matching_loss"]

# Units of each layer, and residual blocks.
HIDDEN, NUM_BLOCKS = 64, 5
# Steps of the integration, of second order. Each evaluates the field twice.
NUM_STEPS = 10
# The share of the start that is left at the end of a path.
SIGMA = 1e-4


class VelocityField(nn.Module):
    r"""A residual network :math:`v(z, t, c)`.

    The last layer starts at zero, so that an untrained field moves nothing.

    Args:
        size: Entries of z.
        condition: Maps conditions ``(n, *event)`` to vectors ``(n, k)``.
        condition_size: k.
    """

    def __init__(self, size: int, condition: nn.Module, condition_size: int) -> None:
        super().__init__()
        self.condition = condition
        self.first = nn.Linear(size + condition_size + 1, HIDDEN)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.Linear(HIDDEN, HIDDEN), nn.ELU(), nn.Linear(HIDDEN, HIDDEN)
            )
            for _ in range(NUM_BLOCKS)
        )
        self.last = nn.Linear(HIDDEN, size)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, z: Tensor, t: Tensor, c: Tensor) -> Tensor:
        """Return the velocities, ``(n, m)``.

        Args:
            z: Where, shape ``(n, m)``.
            t: When, shape ``(n, 1)``.
            c: Conditions that ``condition`` has mapped, shape ``(n, k)``.
        """
        hidden = self.first(torch.cat([z, t, c], dim=1))
        for block in self.blocks:
            hidden = hidden + block(hidden)
        return self.last(hidden)


def matching_loss(
    field: VelocityField, start: Tensor, end: Tensor, c: Tensor
) -> Tensor:
    r"""Return the loss of flow matching along straight paths, each at a random time.

    .. math::
        \bigl\lVert v\bigl((1 - (1 - \sigma) t) z_0 + t z_1,\, t,\, c\bigr)
        - (z_1 - z_0) \bigr\rVert^2 / m, \qquad t \sim U(0, 1)

    Args:
        field: The velocity field.
        start: :math:`z_0`, shape ``(n, m)``.
        end: :math:`z_1`, shape ``(n, m)``.
        c: Conditions, mapped, shape ``(n, k)``.
    """
    t = torch.rand_like(start[:, :1])
    between = (1 - (1 - SIGMA) * t) * start + t * end
    return (field(between, t, c) - (end - start)).square().mean()


def follow(field: VelocityField, z: Tensor, c: Tensor) -> Tensor:
    """Carry points ``(n, m)`` along the field, from time 0 to 1."""

    def velocity(z: Tensor, t: float) -> Tensor:
        return field(z, torch.full_like(z[:, :1], t), c)

    return _integrated(velocity, z, start=0.0, end=1.0)


def follow_back(field: VelocityField, z: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    r"""Carry points back, from time 1 to 0.

    Returns:
        The points, ``(n, m)``, and :math:`\int_0^1 \nabla \cdot v\, dt` along their
        ways, ``(n,)``.
    """

    def velocity(state: Tensor, t: float) -> Tensor:
        z = state[:, :-1]
        time = torch.full_like(z[:, :1], t)
        directions = torch.eye(z.shape[1]).to(z)
        divergence = torch.zeros_like(time)
        v = torch.zeros_like(z)
        for k, direction in enumerate(directions):
            moved: Any = torch.func.jvp(
                lambda z: field(z, time, c), (z,), (direction.expand_as(z),)
            )
            v, change = moved
            divergence = divergence + change[:, k : k + 1]
        return torch.cat([v, divergence], dim=1)

    state = torch.cat([z, torch.zeros_like(z[:, :1])], dim=1)
    state = _integrated(velocity, state, start=1.0, end=0.0)
    # The way back has summed it with the opposite sign.
    return state[:, :-1], -state[:, -1]


def _integrated(
    velocity: Callable[[Tensor, float], Tensor], z: Tensor, *, start: float, end: float
) -> Tensor:
    """Integrate by the midpoint rule, so that ways there and back nearly agree."""
    step = (end - start) / NUM_STEPS
    for k in range(NUM_STEPS):
        t = start + k * step
        middle = z + 0.5 * step * velocity(z, t)
        z = z + step * velocity(middle, t + 0.5 * step)
    return z
