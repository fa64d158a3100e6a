r"""The bounds of parameters, and the map of what is inside to the whole line.

The map is

.. math:: \phi_j(\theta) = \theta_j,\quad \log(\theta_j - a_j),\quad
    -\log(b_j - \theta_j) \quad\text{or}\quad
    \log\frac{\theta_j - a_j}{b_j - \theta_j},

if parameter j has no bound, the lower bound a, the upper bound b, or both.
"""

from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import constraints

from sbi_rope._random import seeded

__all__ = ["bounds_of", "box_of", "moved_inside", "off_bounds", "support_of"]

# Parameters that are nearer to a bound than float32 rounds are taken for on the bound.
ROUNDING = torch.finfo(torch.float32).eps
# So many draws of the prior are moved apart to see whether its support is a box.
NUM_DRAWS = 256


def box_of(prior: Any) -> tuple[Tensor, Tensor] | None:
    """Return the bounds of a prior, float64; None if its support is no whole box."""
    with seeded(0):
        theta = prior.sample((NUM_DRAWS,)).double()
    low, high = bounds_of(prior, theta[0])
    line = _to_line(theta, low, high)
    wider = 2.0 * line - line.mean(dim=0)
    inside = within_support(prior, _to_box(wider, low, high))
    return (low, high) if bool(inside.all()) else None


def bounds_of(prior: Any, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ends of the prior's support, infinite where they are not known.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        like: A tensor of shape ``(*batch, d)``, whose shape, dtype and device the ends
            get.

    Example:
        >>> from torch.distributions import Independent, Uniform
        >>> box = Independent(Uniform(torch.zeros(2), torch.ones(2)), 1)
        >>> bounds_of(box, torch.zeros(2))
        (tensor([0., 0.]), tensor([1., 1.]))
    """
    return _bounds(support_of(prior), like)


def support_of(prior: Any) -> Any:
    """Return the support that a prior states, a constraint of torch; None if none."""
    try:
        return getattr(prior, "support", None)
    except NotImplementedError:  # torch raises it if a distribution states no support
        return None


def moved_inside(prior: Any, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return parameters ``(n, d)``, those outside the support replaced by one inside.

    Outside, torch's distributions raise an error, and networks may return anything,
    NaN and gradients of NaN included. What was computed there is to be overwritten.

    Args:
        prior: A prior that can be sampled.
        theta: Parameters, shape ``(n, d)``.

    Returns:
        The parameters, and which of them were inside, ``(n,)``.

    Example:
        >>> from torch.distributions import Independent, Uniform
        >>> box = Independent(Uniform(torch.zeros(1), torch.ones(1)), 1)
        >>> theta, inside = moved_inside(box, torch.tensor([[0.5], [2.0]]))
        >>> bool(theta[1] < 1), inside
        (True, tensor([ True, False]))
    """
    inside = within_support(prior, theta).reshape(len(theta))
    with seeded(0):
        filler = prior.sample(torch.Size((1,))).to(theta)
    return torch.where(inside[:, None], theta, filler), inside


def off_bounds(prior: Any, theta: Tensor) -> Tensor:
    """Return parameters ``(n, d)``, those on a bound moved to the next number inside.

    Many densities are zero or infinite on a bound. Discrete parameters stay.

    Example:
        >>> from torch.distributions import Independent, Uniform
        >>> box = Independent(Uniform(torch.zeros(1), torch.ones(1)), 1)
        >>> off_bounds(box, torch.tensor([[0.5], [1.0]])) < 1
        tensor([[True],
                [True]])
    """
    low, high = bounds_of(prior, theta)
    inside = theta.clamp(low.nextafter(high), high.nextafter(low))
    return theta.where(_is_discrete(support_of(prior), theta), inside)


def _is_discrete(support: Any, like: Tensor) -> Tensor:
    if isinstance(support, constraints.independent):
        return _is_discrete(support.base_constraint, like)
    if isinstance(support, constraints.cat):
        columns = like.split(support.lengths, dim=-1)
        parts = [_is_discrete(*one) for one in zip(support.cseq, columns, strict=True)]
        return torch.cat(parts, dim=-1)
    return torch.full_like(
        like, bool(getattr(support, "is_discrete", False)), dtype=torch.bool
    )


def _bounds(support: Any, like: Tensor) -> tuple[Tensor, Tensor]:
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    if isinstance(support, constraints.cat):  # of sbi's MultipleIndependent
        columns = like.split(support.lengths, dim=-1)
        ends = [_bounds(*one) for one in zip(support.cseq, columns, strict=True)]
        low, high = (torch.cat(some, dim=-1) for some in zip(*ends, strict=True))
        return low, high
    unknown = (0.0, 1.0) if support is constraints.boolean else (-torch.inf, torch.inf)
    low, high = (
        torch.as_tensor(getattr(support, name, end)).to(like).expand_as(like)
        for name, end in zip(("lower_bound", "upper_bound"), unknown, strict=True)
    )
    return low, high


def _to_line(theta: Tensor, low: Tensor, high: Tensor) -> Tensor:
    r"""Return :math:`\phi(\theta)` of parameters ``(..., d)`` inside the bounds.

    Parameters on a bound are taken for some next to it, in a box for those that float32
    can tell from the bound.
    """
    has_low, has_high = torch.isfinite(low), torch.isfinite(high)
    least = _margin(low, high).clamp_min(torch.finfo(theta.dtype).tiny)
    above = (theta - low).maximum(least).log().where(has_low, 0.0)
    below = (high - theta).maximum(least).log().where(has_high, 0.0)
    return (above - below).where(has_low | has_high, theta)


def _to_box(line: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the parameters inside the bounds that are mapped to a line."""
    has_low, has_high = torch.isfinite(low), torch.isfinite(high)
    one_sided = (low + line.exp()).where(has_low, high - (-line).exp())
    inside = low + (high - low) * line.sigmoid()
    bounded = inside.where(has_low & has_high, one_sided)
    return bounded.where(has_low | has_high, line)


def _margin(low: Tensor, high: Tensor) -> Tensor:
    """Return how near to one of two bounds is on it, ``(d,)``; zero otherwise."""
    width = high - low
    return (ROUNDING * width).where(torch.isfinite(width), 0.0)
