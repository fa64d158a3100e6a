"""The prior as the ELBO needs it: finite everywhere, with a gradient back inside."""

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._bounds import box_of
from sbi_rope._random import seeded
from sbi_rope.errors import InvalidInputError

__all__ = ["ContinuedPrior"]

# Length over which the continued density falls by a factor of e, and how far inside
# its ends the support is cut, in standard deviations of the prior. Some densities, that
# of the light tunnel's polarisers for one, are infinite at the ends.
FLANK = 0.1
MARGIN = 1e-3
# Draws that tell the standard deviations.
NUM_DRAWS = 10_000


class ContinuedPrior:
    r"""A prior on a box whose density falls off outside of it instead of ending.

    With :math:`\bar\theta` the nearest point in the box and :math:`s` the standard
    deviations of the prior,

    .. math::
        \log \tilde p(\theta) = \log p(\bar\theta)
        - \sum_k \frac{|\theta_k - \bar\theta_k|}{0.1\, s_k}.

    A flow puts some of its mass outside of the support. There the ELBO would be minus
    infinity and without a gradient; this one is finite and leads back inside.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``, its support a
            box, whose sides may be infinite.
        device: Where the parameters will be.

    Raises:
        InvalidInputError: If the support is not a box.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> prior = ContinuedPrior(BoxUniform(torch.zeros(1), torch.ones(1)))
        >>> prior.nearest(torch.tensor([[0.5], [3.0]])).round(decimals=2)
        tensor([[0.5000],
                [1.0000]])
    """

    def __init__(
        self, prior: Distribution, *, device: str | torch.device = "cpu"
    ) -> None:
        self._prior = prior
        with seeded(0):
            std = prior.sample(torch.Size((NUM_DRAWS,))).std(dim=0)
        box = box_of(prior)
        if box is None:
            raise InvalidInputError(
                f"Expected a prior whose support is a box; got {type(prior).__name__}."
            )
        self.std = std.to(device, torch.float32)
        self.low = box[0].to(self.std) + MARGIN * self.std
        self.high = box[1].to(self.std) - MARGIN * self.std

    def nearest(self, theta: Tensor) -> Tensor:
        """Return the nearest points in the box, ``(n, d)``."""
        return theta.clamp(self.low, self.high)

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the continued log density, ``(n, d)`` to ``(n,)``."""
        inside = self.nearest(theta)
        distance = ((theta - inside).abs() / (FLANK * self.std)).sum(dim=1)
        return self._prior.log_prob(inside) - distance
