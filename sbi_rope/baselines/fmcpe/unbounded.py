"""Parameters as vectors without bounds."""

import copy
from collections.abc import Callable
from typing import Any

import torch
from sbi.utils import mcmc_transform
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._bounds import bounds_of
from sbi_rope._random import seeded
from sbi_rope.baselines.fmcpe.standardise import Standardise

__all__ = ["Unbounded"]

# Draws of the prior behind its moments.
NUM_DRAWS = 10_000
# Parameters keep this distance from bounds, as a share of the range.
MARGIN = 1e-3


class Unbounded(nn.Module):
    r"""Parameters without bounds, in standard deviations of the prior.

    Parameters that are on a bound, or nearer to it than a thousandth of the range, are
    taken for parameters at that distance. On the bound they would be infinitely far
    away, and the density there would be arbitrary.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
    """

    low: Tensor
    high: Tensor

    def __init__(self, prior: Distribution) -> None:
        super().__init__()
        self.prior = copy.deepcopy(prior)
        with seeded(0):
            draws = self.prior.sample(torch.Size((NUM_DRAWS,))).float()
        self._set_transform(draws.device)
        low, high = bounds_of(self.prior, draws[0])
        # Where only one bound is known, the range is that of a uniform distribution
        # with the same standard deviation.
        margin = MARGIN * 12**0.5 * draws.std(dim=0)
        self.register_buffer("low", low + margin)
        self.register_buffer("high", high - margin)
        self.unit = Standardise(self._transform(self._off_bounds(draws)))

    def _set_transform(self, device: torch.device) -> None:
        if hasattr(self.prior, "to"):
            self.prior.to(device)  # type: ignore[attr-defined]
        with seeded(0):  # sbi draws from the prior to look at it
            self._transform: Any = mcmc_transform(self.prior, device=str(device))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        before = self.unit.mean.device
        moved = super()._apply(fn, recurse)
        if self.unit.mean.device != before:
            self._set_transform(self.unit.mean.device)
        return moved

    def _off_bounds(self, theta: Tensor) -> Tensor:
        return theta.maximum(self.low.to(theta)).minimum(self.high.to(theta))

    def transformed(self, theta: Tensor) -> Tensor:
        """Return parameters without bounds, ``(n, d)``."""
        return self.unit(self._transform(self._off_bounds(theta)))

    def inverse(self, u: Tensor) -> Tensor:
        """Return the parameters of transformed ones, ``(n, d)``."""
        return self._transform.inv(self.unit.inverse(u))

    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters ``(n, d)`` can be transformed."""
        return self.transformed_inside(theta)[2]

    def replaced(self, theta: Tensor) -> Tensor:
        """Replace parameters outside the prior's support by draws of the prior."""
        prior = self.prior.sample(torch.Size((len(theta),))).to(theta)
        return torch.where(self.contains(theta)[:, None], theta, prior)

    def transformed_inside(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transform parameters that may be outside the prior's support.

        Returns:
            Transformed parameters ``(n, d)``, the logarithm of the volume that the
            transform multiplies by, ``(n,)``, and which rows are inside. The others
            have zeros.
        """
        try:
            support: Any = self.prior.support
            inside = support.check(theta)
        except (AttributeError, NotImplementedError):
            inside = torch.ones_like(theta[:, 0], dtype=torch.bool)
        if inside.ndim == 2:
            inside = inside.all(dim=1)
        some = self._transform.inv(self.unit.mean.expand_as(theta))
        safe = torch.where(inside[:, None], self._off_bounds(theta), some)
        u = self.unit(self._transform(safe))
        log_scale = self.log_scale(u)
        inside = inside & torch.isfinite(u).all(dim=1) & torch.isfinite(log_scale)
        u, log_scale = u.where(inside[:, None], 0.0), log_scale.where(inside, 0.0)
        return u, log_scale, inside

    def log_scale(self, u: Tensor) -> Tensor:
        """Return the log volume that the transform to u multiplies by, ``(n,)``.

        It does not go by the parameters, which can be on a bound by rounding.
        """
        line = self.unit.inverse(u).double()
        log_scale = -self._transform.inv.log_abs_det_jacobian(
            line, self._transform.inv(line)
        )
        if log_scale.ndim == 2:
            log_scale = log_scale.sum(dim=1)
        return log_scale.to(u) - self.unit.std.log().sum()
