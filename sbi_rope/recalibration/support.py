"""The bounds of parameters whose distribution can be made narrower or wider."""

from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.errors import UnsupportedPosteriorError
from sbi_rope.recalibration.spread import Spread, to_line
from sbi_rope.sets.intervals import bounds_of

__all__ = ["box_of"]

# So many draws of the prior are moved apart to see whether its support is a box.
NUM_DRAWS = 256


def box_of(prior: Any) -> tuple[Tensor, Tensor]:
    """Return the bounds of each parameter, infinite where there is none.

    Args:
        prior: A prior with the support of a box, such as ``BoxUniform``, or of the
            whole space.

    Returns:
        The lower and the upper bounds, both of shape ``(d,)``, float64.

    Raises:
        UnsupportedPosteriorError: If the support is something else, so that a wider
            distribution would leave it.
    """
    with seeded(0):
        theta = prior.sample((NUM_DRAWS,)).double()
    low, high = bounds_of(prior, theta[0])
    line = to_line(theta, low, high)
    wider = Spread(line.mean(dim=0), torch.full_like(low, 2.0), low, high)
    if not within_support(prior, wider.forward(theta)).all():
        raise UnsupportedPosteriorError(
            "Expected a prior whose support has bounds for each parameter by itself, "
            f"such as BoxUniform, to recalibrate; got {type(prior).__name__}. Leave "
            "`recalibrate` out."
        )
    return low, high
