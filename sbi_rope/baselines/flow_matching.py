"""Velocity fields that carry one distribution to another, and their units."""

from collections.abc import Callable
from typing import Any

import torch
from sbi.utils import mcmc_transform
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.standardisation import ROUNDING
from sbi_rope.utils.seeds import seeded

# Units of each layer, and residual blocks.
HIDDEN, NUM_BLOCKS = 64, 5
# Steps of the integration, of second order. Each evaluates the field twice.
NUM_STEPS = 10
# The share of the start that is left at the end of a path.
SIGMA = 1e-4
# Draws of the prior behind its moments.
NUM_DRAWS = 10_000
# Parameters keep this distance from bounds, as a share of the range.
MARGIN = 1e-3


class VelocityField(nn.Module):
    r"""A residual network :math:`v(z, t, c)`.

    The last layer starts at zero, so that an untrained field moves nothing. The
    conditions c are vectors, to which ``condition`` maps observations.
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
        """Return velocities ``(n, m)``, at times ``(n, 1)`` and mapped conditions."""
        hidden = self.first(torch.cat([z, t, c], dim=1))
        for block in self.blocks:
            hidden = hidden + block(hidden)
        return self.last(hidden)

    def loss(self, start: Tensor, end: Tensor, c: Tensor) -> Tensor:
        r"""Return the loss of flow matching along straight paths, at random times.

        .. math::
            \bigl\lVert v\bigl((1 - (1 - \sigma) t) z_0 + t z_1,\, t,\, c\bigr)
            - (z_1 - z_0) \bigr\rVert^2 / m, \qquad t \sim U(0, 1)
        """
        t = torch.rand_like(start[:, :1])
        between = (1 - (1 - SIGMA) * t) * start + t * end
        return (self(between, t, c) - (end - start)).square().mean()

    def follow(self, z: Tensor, c: Tensor) -> Tensor:
        """Carry points ``(n, m)`` along the field, from time 0 to 1."""
        return _integrated(
            lambda z, t: self(z, torch.full_like(z[:, :1], t), c), z, start=0.0, end=1.0
        )

    def follow_back(self, z: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        r"""Carry points ``(n, m)`` back, from time 1 to 0.

        The second result is :math:`\int_0^1 \nabla \cdot v\, dt` along their ways.
        """

        def velocity(state: Tensor, t: float) -> Tensor:
            z = state[:, :-1]
            time = torch.full_like(z[:, :1], t)
            v, divergence = torch.zeros_like(z), torch.zeros_like(time)
            for k, direction in enumerate(torch.eye(z.shape[1]).to(z)):
                moved: Any = torch.func.jvp(
                    lambda z: self(z, time, c), (z,), (direction.expand_as(z),)
                )
                v, divergence = moved[0], divergence + moved[1][:, k : k + 1]
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


class Standardise(nn.Module):
    """Rows ``(n, m)`` in standard deviations from their mean; ``inverse`` undoes it.

    A column that does not vary has a deviation of one. The columns of a series share
    one, that of columns that vary.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, rows: Tensor, *, shared: bool = False) -> None:
        super().__init__()
        std, mean = torch.std_mean(rows, dim=0)
        smallest = ROUNDING * mean.abs().clamp_min(ROUNDING)
        varies = std > smallest
        if shared and varies.any():
            std = std[varies].square().mean().sqrt().expand_as(std).clone()
        else:
            std = std.where(varies, torch.ones_like(std))
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, rows: Tensor) -> Tensor:
        """Return the standardised rows, ``(n, m)``."""
        return (rows - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """Return the rows of standardised ones, ``(n, m)``."""
        return self.mean + self.std * z


class Unbounded(nn.Module):
    r"""Parameters without bounds, in standard deviations of the prior.

    Parameters that are on a bound, or nearer to it than a thousandth of the range, are
    taken for parameters at that distance. On the bound they would be infinitely far
    away, and the density there would be arbitrary.
    """

    low: Tensor
    high: Tensor

    def __init__(self, prior: Distribution) -> None:
        super().__init__()
        self._prior = PriorDistribution(prior)
        with seeded(0):
            draws = self._prior.sample((NUM_DRAWS,))
        low, high = self._prior.bounds(draws[0])
        # Where only one bound is known, the range is that of a uniform distribution
        # with the same standard deviation.
        margin = MARGIN * 12**0.5 * draws.std(dim=0)
        self.register_buffer("low", low + margin)
        self.register_buffer("high", high - margin)
        self.unit = Standardise(self._transform(self._off_bounds(draws)))

    @property
    def prior(self) -> PriorDistribution:
        """The prior, where the parameters are: it is no module that could be moved."""
        self._prior.to(self.low.device)
        return self._prior

    @property
    def _transform(self) -> Any:
        with seeded(0):  # sbi draws from the prior to look at it
            return mcmc_transform(self.prior, device=str(self.low.device))

    def _off_bounds(self, theta: Tensor) -> Tensor:
        return theta.maximum(self.low.to(theta)).minimum(self.high.to(theta))

    def transformed(self, theta: Tensor) -> Tensor:
        """Return parameters inside the support without bounds, ``(n, d)``."""
        return self.unit(self._transform(self._off_bounds(theta)))

    def inverse(self, u: Tensor) -> Tensor:
        """Return the parameters of transformed ones, ``(n, d)``."""
        return self._transform.inv(self.unit.inverse(u))

    def log_scale(self, u: Tensor) -> Tensor:
        """Return the log volume that the transform to u multiplies by, ``(n,)``.

        It does not go by the parameters, which can be on a bound by rounding.
        """
        inverse, line = self._transform.inv, self.unit.inverse(u).double()
        log_scale = -inverse.log_abs_det_jacobian(line, inverse(line)).to(u)
        return log_scale.reshape(len(u), -1).sum(dim=1) - self.unit.std.log().sum()
