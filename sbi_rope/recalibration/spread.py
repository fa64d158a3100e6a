"""A map that spreads or narrows a distribution of parameters around its centre.

Parameters with bounds are first mapped to the whole line, so that no mass leaves them.
"""

from dataclasses import dataclass, replace

from torch import Tensor

from sbi_rope._bounds import log_slope, to_box, to_line

__all__ = ["Spread"]


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
