"""What a prior says of its parameters: their bounds, their units and their density."""

from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import constraints

from sbi_rope._random import seeded

__all__ = [
    "bounds_of",
    "box_of",
    "divisors",
    "is_unbounded",
    "log_unit_of",
    "log_units_of",
    "moved_inside",
    "off_bounds",
    "prior_log_prob",
    "prior_sample",
    "std_of_prior",
]

# So many draws of the prior are moved apart to see whether its support is a box.
NUM_DRAWS = 256
# Draws from which a standard deviation is estimated that the prior does not state.
NUM_FOR_STD = 10_000


def prior_sample(prior: Any, sample_shape: torch.Size) -> Tensor:
    """Draw from a prior over parameters of shape ``(d,)``, ``(*sample_shape, d)``."""
    # sbi's MultipleIndependent takes sample shapes with one dimension only.
    theta = prior.sample(torch.Size((sample_shape.numel(),)))
    return theta.reshape(*sample_shape, *theta.shape[1:])


def prior_log_prob(prior: Any, theta: Tensor) -> Tensor:
    r"""Return the log density at theta ``(*batch, d)``, shape ``(*batch)``.

    It is :math:`-\infty` outside the support, and on a bound that just inside. There
    are gradients even where the density is flat; they are zero there.
    """
    shape = theta.shape[:-1]
    # sbi's MultipleIndependent takes theta with at most two dimensions.
    theta = theta.reshape(-1, theta.shape[-1])
    theta = theta if theta.is_floating_point() else theta.float()
    safe, inside = moved_inside(prior, theta)
    log_prob = prior.log_prob(off_bounds(prior, safe)) + 0.0 * safe.sum(dim=-1)
    return log_prob.where(inside, -torch.inf).reshape(shape)


def moved_inside(prior: Any, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return parameters ``(n, d)``, those outside the support replaced by one inside.

    Outside, torch's distributions raise an error, and networks may return anything,
    NaN and gradients of NaN included. What was computed there is to be overwritten.

    Returns:
        The parameters, and which of them were inside, ``(n,)``.
    """
    inside = within_support(prior, theta).reshape(len(theta))
    with seeded(0):
        filler = prior.sample(torch.Size((1,))).to(theta)
    return torch.where(inside[:, None], theta, filler), inside


# --- bounds ---


def bounds_of(prior: Any, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ends of the prior's support, infinite where they are not known.

    They get the shape ``(*batch, d)``, dtype and device of ``like``.
    """
    return _bounds(_support_of(prior), like)


def box_of(prior: Any) -> tuple[Tensor, Tensor] | None:
    """Return the bounds of a prior, float64; None if its support is no whole box."""
    with seeded(0):
        theta = prior.sample((NUM_DRAWS,)).double()
    # In a box, any parameters between the bounds are inside.
    apart = off_bounds(prior, 2.0 * theta - theta.mean(dim=0))
    inside = within_support(prior, apart).all()
    return bounds_of(prior, theta[0]) if bool(inside) else None


def off_bounds(prior: Any, theta: Tensor) -> Tensor:
    """Return parameters ``(n, d)``, those on a bound moved to the next number inside.

    Many densities are zero or infinite on a bound. Discrete parameters stay.
    """
    low, high = bounds_of(prior, theta)
    inside = theta.clamp(low.nextafter(high), high.nextafter(low))
    return theta.where(_is_discrete(_support_of(prior), theta), inside)


def is_unbounded(prior: Any) -> bool:
    """Tell whether a prior says that its support is the whole space."""
    return _support_of(prior) in (constraints.real, constraints.real_vector)


def _support_of(prior: Any) -> Any:
    """Return the support that a prior states, a constraint of torch; None if none."""
    try:
        support = getattr(prior, "support", None)
    except NotImplementedError:  # torch raises it if a distribution states no support
        return None
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    return support


def _is_discrete(support: Any, like: Tensor) -> Tensor:
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


# --- units ---


def divisors(std: Tensor) -> Tensor:
    """Return standard deviations, or variances, with one in the place of zero.

    What does not vary may be divided by them. A smallest number would be wrong for
    parameters in units that make all of them small.
    """
    return std.where(std > 0, 1.0)


def log_unit_of(prior: Any) -> float:
    """Return the sum of :func:`log_units_of`; NaN if one of them is unknown."""
    return float(log_units_of(prior).sum())


def log_units_of(prior: Any) -> Tensor:
    r"""Return :math:`\log s_j`, with s the standard deviations of the prior, ``(d,)``.

    The density of :math:`z_j = \theta_j / s_j` is
    :math:`p(z \mid x) = p(\theta \mid x) \prod_j s_j`, so that a log score with theta
    in standard deviations of the prior is higher by their sum. It is NaN where the
    prior has no finite standard deviation.
    """
    std = std_of_prior(prior)
    return std.log().where((std > 0) & torch.isfinite(std), torch.nan)


def std_of_prior(prior: Any) -> Tensor:
    """Return the standard deviations of a prior, ``(d,)``; estimated if not stated."""
    try:
        std = prior.stddev
    except Exception:  # priors of users and of sbi raise all kinds
        with seeded(0):
            std = prior.sample(torch.Size((NUM_FOR_STD,))).std(dim=0)
    return torch.as_tensor(std).detach().double()
