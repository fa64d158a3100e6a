"""Standard deviations, as units of theta and of log scores."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope._random import seeded

__all__ = ["divisors", "log_unit_of", "log_units_of", "std_of_prior"]

# Draws that the standard deviation is estimated from if the prior does not state it.
NUM_DRAWS = 10_000


def divisors(std: Tensor) -> Tensor:
    """Return standard deviations, or variances, with one in the place of zero.

    What does not vary may be divided by them. A smallest number would be wrong for
    parameters in units that make all of them small.

    Example:
        >>> divisors(torch.tensor([2.0, 1e-20, 0.0]))
        tensor([2.0000e+00, 1.0000e-20, 1.0000e+00])
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
            std = prior.sample(torch.Size((NUM_DRAWS,))).std(dim=0)
    return torch.as_tensor(std).detach().double()
