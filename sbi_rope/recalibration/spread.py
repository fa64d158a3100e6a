r"""A map that spreads or narrows a distribution of parameters around its centre.

Parameters with a bounded support are first mapped to the whole line,

.. math:: \phi_j(\theta) = \theta_j,\quad \log(\theta_j - a_j),\quad
    -\log(b_j - \theta_j) \quad\text{or}\quad
    \log\frac{\theta_j - a_j}{b_j - \theta_j},

if the support of parameter j has no bound, the lower bound a, the upper bound b, or
both. So no mass leaves the support.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import softplus

__all__ = ["Spread", "log_slope", "to_box", "to_line"]


@dataclass(frozen=True, eq=False)
class Spread:
    r"""Multiplies the distances from a centre by a factor for each parameter.

    .. math:: \phi_j(\theta'_j) = \mu_j + s_j\, (\phi_j(\theta_j) - \mu_j)

    Attributes:
        centre: :math:`\mu`, shape ``(B, d)``, on the line.
        factors: :math:`s`, shape ``(d,)``; below 1 the distribution becomes narrower.
        low: Lower bounds, shape ``(d,)``, minus infinity where there is none.
        high: Upper bounds, shape ``(d,)``, infinity where there is none.
    """

    centre: Tensor
    factors: Tensor
    low: Tensor
    high: Tensor

    def with_factors(self, factors: Tensor) -> "Spread":
        """Return the map with other factors, of a shape that fits ``(S, B, d)``."""
        return replace(self, factors=factors.to(self.centre))

    def of_rows(self, rows: Tensor) -> "Spread":
        """Return the map of some observations."""
        return replace(self, centre=self.centre[rows])

    def forward(self, theta: Tensor) -> Tensor:
        """Return what parameters ``(S, B, d)`` inside the bounds are mapped to."""
        line = to_line(theta.double(), self.low, self.high)
        moved = self.centre + self.factors * (line - self.centre)
        return to_box(moved, self.low, self.high).to(theta)

    def inverse(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return what is mapped to parameters, and the log of the inverse's slope.

        Args:
            theta: :math:`\theta'`, shape ``(S, B, d)``, inside the bounds.

        Returns:
            :math:`\theta`, shape ``(S, B, d)``, and
            :math:`\log |d \theta / d \theta'|`, shape ``(S, B)``, float64.
        """
        line = to_line(theta.double(), self.low, self.high)
        moved = self.centre + (line - self.centre) / self.factors
        before = log_slope(line, self.low, self.high)
        after = log_slope(moved, self.low, self.high)
        slope = (after - before - self.factors.log()).sum(dim=-1)
        return to_box(moved, self.low, self.high).to(theta), slope


def to_line(theta: Tensor, low: Tensor, high: Tensor) -> Tensor:
    r"""Return :math:`\phi(\theta)` of parameters ``(..., d)`` inside the bounds.

    Parameters on a bound are taken for the nearest number inside.

    Example:
        >>> low, high = torch.tensor([0.0, 0.0]), torch.tensor([torch.inf, 1.0])
        >>> to_line(torch.tensor([1.0, 0.5]), low, high)
        tensor([0., 0.])
    """
    has_low, has_high = torch.isfinite(low), torch.isfinite(high)
    tiny = torch.finfo(theta.dtype).tiny
    # Infinite bounds are replaced first, because gradients go through both branches.
    above = (theta - low.where(has_low, 0.0)).clamp_min(tiny).log()
    below = (high.where(has_high, 0.0) - theta).clamp_min(tiny).log()
    line = above.where(has_low, 0.0) - below.where(has_high, 0.0)
    return line.where(has_low | has_high, theta)


def to_box(line: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the parameters inside the bounds that :func:`to_line` maps to a line.

    Example:
        >>> low, high = torch.tensor([0.0, 0.0]), torch.tensor([torch.inf, 1.0])
        >>> to_box(torch.tensor([0.0, 0.0]), low, high)
        tensor([1.0000, 0.5000])
    """
    has_low, has_high = torch.isfinite(low), torch.isfinite(high)
    a, b = low.where(has_low, 0.0), high.where(has_high, 0.0)
    above = a + line.where(has_low & ~has_high, 0.0).exp()
    below = b - (-line).where(has_high & ~has_low, 0.0).exp()
    inside = a + (b - a) * line.sigmoid()
    one_sided = above.where(has_low, below)
    bounded = inside.where(has_low & has_high, one_sided)
    return bounded.where(has_low | has_high, line)


def log_slope(line: Tensor, low: Tensor, high: Tensor) -> Tensor:
    r"""Return :math:`\log |d \theta_j / d \phi_j|` of each parameter, ``(..., d)``."""
    has_low, has_high = torch.isfinite(low), torch.isfinite(high)
    width = (high - low).where(has_low & has_high, 1.0)
    inside = width.log() - softplus(line) - softplus(-line)
    slope = inside.where(has_high, line)
    slope = slope.where(has_low, -line)
    return slope.where(has_low | has_high, 0.0)
