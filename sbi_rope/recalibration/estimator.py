"""A mixture that is narrower or wider than that of its parts."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.mixture import MixtureEstimator
from sbi_rope.mixture.sampling import Accept
from sbi_rope.recalibration.spread import Spread, to_box, to_line

__all__ = ["RecalibratedEstimator"]

# The centre of each observation is the mean of so many draws. With factors near 1 an
# error of the centre hardly matters.
NUM_DRAWS = 256


class RecalibratedEstimator(MixtureEstimator):
    r"""A mixture whose distance from its centre is multiplied by factors.

    .. math:: p'(\theta' \mid x) = p(\theta \mid x)
        \left| \frac{d \theta}{d \theta'} \right|, \qquad
        \phi(\theta') = \mu(x) + s\, (\phi(\theta) - \mu(x))

    :math:`\phi` maps the support of the prior to the whole space, see
    :mod:`sbi_rope.recalibration.spread`, and :math:`\mu(x)` is the mean of
    :math:`\phi(\theta)` under the mixture inside the support. It is estimated from 256
    draws, whose random numbers are the same in every call.

    Args:
        mixture: The mixture.
        factors: s, shape ``(d,)``.
        low: The lower ends of the prior's support, shape ``(d,)``, minus infinity where
            there is none.
        high: The upper ends, shape ``(d,)``, infinity where there is none.
    """

    factors: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, mixture: MixtureEstimator, factors: Tensor, low: Tensor, high: Tensor
    ) -> None:
        super().__init__(mixture.parts, mixture.weights, tail_mass=mixture.tail_mass)
        buffers = {"factors": factors, "low": low, "high": high}
        for name, value in buffers.items():
            self.register_buffer(name, value.to(mixture.weights))

    def restricted_to(self, index: int) -> "RecalibratedEstimator":
        """Return the same for one observation of the batch."""
        mixture = super().restricted_to(index)
        return RecalibratedEstimator(mixture, self.factors, self.low, self.high)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log p'(\theta \mid x)`, minus infinity outside the bounds.

        Args:
            input: As in :meth:`MixtureEstimator.log_prob`.
            condition: As in :meth:`MixtureEstimator.log_prob`.
            **kwargs: Not used; they are in sbi's signature.

        Returns:
            Shape ``(S, B)``.

        Raises:
            InvalidInputError: As in :meth:`MixtureEstimator.log_prob`.
            UnseenObservationError: As in :meth:`MixtureEstimator.log_prob`.
        """
        theta, x = self._checked_theta(input), self.checked_x(condition)
        if not theta.numel():
            return self.log_prob_before(theta, x)
        inside = self._inside(theta)
        # Parameters outside are replaced, so that there are no gradients of NaN.
        somewhere = to_box(torch.zeros_like(self.low), self.low, self.high).to(theta)
        theta = theta.where(inside[..., None], somewhere)
        moved, slope = self.spread(x).inverse(theta)
        log_prob = self.log_prob_before(moved, x) + slope
        return log_prob.where(inside, -torch.inf).to(theta)

    def log_prob_before(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the log density of the mixture before its spread was changed."""
        return super().log_prob(theta, x)

    @torch.no_grad()
    def sample(
        self,
        sample_shape: torch.Size,
        condition: Tensor,
        *,
        accept: Accept | None = None,
        **options: Any,
    ) -> Tensor:
        """Draw from the mixtures of a batch, inside the bounds.

        Args:
            sample_shape: Shape of the draws of each observation.
            condition: Observations, shape ``(B, *event)``.
            accept: Tells which draws ``(n, d)`` of the mixture to keep, before they are
                moved. None keeps those inside the bounds.
            **options: As in :meth:`MixtureEstimator.sample`.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            SamplingError: If hardly any draw is accepted for some observation.
            UnseenObservationError: As in :meth:`MixtureEstimator.log_prob`.
        """
        accept = self._inside if accept is None else accept
        draws = super().sample(sample_shape, condition, accept=accept, **options)
        theta = draws.reshape(-1, *draws.shape[len(sample_shape) :])
        return self.spread(condition).forward(theta).reshape(draws.shape)

    @torch.no_grad()
    def spread(self, x: Tensor) -> Spread:
        """Return the map of each observation."""
        with seeded(0):
            draws = super().sample(torch.Size((NUM_DRAWS,)), x, accept=self._inside)
        centre = to_line(draws.double(), self.low, self.high).mean(dim=0)
        return Spread(centre, self.factors, self.low, self.high)

    def _inside(self, theta: Tensor) -> Tensor:
        return ((theta >= self.low) & (theta <= self.high)).all(dim=-1)
