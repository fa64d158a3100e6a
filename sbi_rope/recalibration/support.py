"""The bounds of parameters whose distribution is made narrower or wider."""

from dataclasses import dataclass
from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.recalibration.spread import Spread, to_line
from sbi_rope.sets.intervals import bounds_of

__all__ = ["Bounds", "bounds_of_prior"]

# So many draws of the prior are moved apart to see whether its support is a box.
NUM_DRAWS = 256


@dataclass(frozen=True, eq=False)
class Bounds:
    """The bounds of each parameter.

    Attributes:
        low: The lower bounds, minus infinity where there is none, shape ``(d,)``.
        high: The upper bounds, infinity where there is none, shape ``(d,)``.
        are_all: Whether the support holds everything inside the bounds. Otherwise a
            wider distribution reaches beyond it, and has to be cut off there.
    """

    low: Tensor
    high: Tensor
    are_all: bool


def bounds_of_prior(prior: Any) -> Bounds:
    """Return the bounds of a prior's support, float64."""
    with seeded(0):
        theta = prior.sample((NUM_DRAWS,)).double()
    low, high = bounds_of(prior, theta[0])
    line = to_line(theta, low, high)
    wider = Spread(line.mean(dim=0), torch.full_like(low, 2.0), low, high)
    inside = within_support(prior, wider.forward(theta))
    return Bounds(low, high, are_all=bool(inside.all()))
