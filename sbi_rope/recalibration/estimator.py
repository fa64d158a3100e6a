"""A mixture that is narrower or wider than that of its parts."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope._bounds import Bounds, to_box, to_line
from sbi_rope._random import seeded
from sbi_rope.errors import SamplingError, UnsupportedPosteriorError
from sbi_rope.mixture import MixtureEstimator
from sbi_rope.mixture.parts import Part
from sbi_rope.mixture.sampling import (
    MIN_ACCEPTANCE,
    MIN_PROPOSALS,
    Accept,
    deadline_after,
)
from sbi_rope.mixture.truncation import LEAKAGE_DRAWS, Leakage
from sbi_rope.recalibration.spread import Spread

__all__ = ["RecalibratedEstimator"]

# The centre of each observation is the mean of so many draws. With factors near 1 an
# error of the centre hardly matters.
NUM_DRAWS = 256
# At most so many draws are made at a time for those outside a support that is no box.
MAX_AT_ONCE = 100_000


class RecalibratedEstimator(MixtureEstimator):
    r"""A mixture whose distance from its centre is multiplied by factors.

    .. math:: p'(\theta' \mid x) = p(\theta \mid x)
        \left| \frac{d \theta}{d \theta'} \right|, \qquad
        \phi(\theta') = \mu(x) + s\, (\phi(\theta) - \mu(x))

    :math:`\phi` maps the support of the prior to the whole space, see
    :mod:`sbi_rope._bounds`, and :math:`\mu(x)` is the mean of
    :math:`\phi(\theta)` under the mixture inside the support. It is estimated from 256
    draws with a seed of their own. The same call always returns the same numbers, but
    an observation has slightly others in another batch.

    If the support is no box, :math:`\phi` knows nothing of its other edges. A mixture
    that became wider is cut off there, as every mixture is.

    Args:
        mixture: The mixture.
        factors: s, shape ``(d,)``.
        bounds: The bounds of the parameters.
    """

    factors: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, mixture: MixtureEstimator, factors: Tensor, bounds: Bounds
    ) -> None:
        super().__init__(mixture.parts, mixture.weights, tail_mass=mixture.tail_mass)
        buffers = {"factors": factors, "low": bounds.low, "high": bounds.high}
        for name, value in buffers.items():
            self.register_buffer(name, value.to(mixture.weights))
        self.is_box = bounds.are_all

    def taken_apart(self) -> tuple[list[Part], list[float]]:
        """Raise, because the parts alone are not recalibrated.

        Raises:
            UnsupportedPosteriorError: Always.
        """
        raise UnsupportedPosteriorError(
            "Expected a posterior that is not recalibrated as a part of another "
            "mixture, because its factors would be lost; got a recalibrated stack. "
            "Make it without `recalibrate`."
        )

    def with_factors(self, factors: Tensor) -> "RecalibratedEstimator":
        """Return the same mixture with other factors."""
        bounds = Bounds(self.low, self.high, self.is_box)
        return RecalibratedEstimator(self, factors, bounds)

    def restricted_to(self, index: int) -> "RecalibratedEstimator":
        """Return the same for one observation of the batch."""
        mixture = super().restricted_to(index)
        bounds = Bounds(self.low, self.high, self.is_box)
        return RecalibratedEstimator(mixture, self.factors, bounds)

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
        theta, x = self._as_samples(input), self.checked_x(condition)
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
        max_sampling_time: float | None = None,
        **options: Any,
    ) -> Tensor:
        """Draw from the mixtures of a batch, inside the bounds.

        Args:
            sample_shape: Shape of the draws of each observation.
            condition: Observations, shape ``(B, *event)``.
            accept: Tells which draws ``(n, d)`` are inside the support; None keeps all
                inside the bounds.
            max_sampling_time: Seconds after which rejection gives up; never if None.
            **options: As in :meth:`MixtureEstimator.sample`.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            SamplingError: If hardly any draw is accepted for some observation, or the
                time is over.
            UnseenObservationError: As in :meth:`MixtureEstimator.log_prob`.
        """
        deadline = deadline_after(max_sampling_time)
        options["max_sampling_time"] = max_sampling_time
        x, count = self.checked_x(condition), torch.Size(sample_shape).numel()
        spread = self.spread(x)
        theta = self._moved(count, x, spread, **options)
        if accept is not None and not self.is_box:
            options["show_progress_bars"] = False
            self._refill(theta, x, spread, accept, deadline=deadline, **options)
        return theta.reshape(*sample_shape, *theta.shape[1:])

    def _moved(self, count: int, x: Tensor, spread: Spread, **options: Any) -> Tensor:
        draws = super().sample(torch.Size((count,)), x, accept=self._inside, **options)
        return spread.forward(draws)

    def _refill(
        self,
        theta: Tensor,
        x: Tensor,
        spread: Spread,
        accept: Accept,
        *,
        deadline: float,
        **options: Any,
    ) -> None:
        """Draw those ``(S, B, d)`` again that a support which is no box leaves out."""
        outside = ~accept(theta.flatten(0, 1)).reshape(theta.shape[:2])
        missing = outside.sum(dim=0)
        proposed = torch.full_like(missing, len(theta))
        accepted = proposed - missing
        while missing.any():
            rows = missing.nonzero().flatten()
            share = (accepted / proposed)[rows]
            hopeless = (proposed[rows] >= MIN_PROPOSALS) & (share < MIN_ACCEPTANCE)
            if hopeless.any():
                raise SamplingError(
                    f"Less than one in {int(1 / MIN_ACCEPTANCE)} draws of the "
                    "recalibrated mixture lies inside the support of the prior for "
                    f"the observations in rows {rows[hopeless][:5].tolist()} of `x`. "
                    "Leave `recalibrate` out, or pass reject_outside_prior=False."
                )
            wanted = int(missing.max() / share.min().clamp(min=MIN_ACCEPTANCE)) + 1
            wanted = min(wanted, max(1, MAX_AT_ONCE // len(rows)))
            fresh = self._moved(wanted, x[rows], spread.of_rows(rows), **options)
            kept = accept(fresh.flatten(0, 1)).reshape(fresh.shape[:2])
            proposed[rows] += wanted
            accepted[rows] += kept.sum(dim=0)
            for column, row in enumerate(rows.tolist()):
                draws = fresh[kept[:, column], column]
                slots = outside[:, row].nonzero().flatten()[: len(draws)]
                theta[slots, row] = draws[: len(slots)]
                outside[slots, row] = False
            missing = outside.sum(dim=0)

    def mass(
        self,
        x: Tensor,
        *,
        accept: Accept | None,
        cache: dict[int, Tensor],
        show_progress_bars: bool = False,
    ) -> Leakage:
        """Return the mass of each observation's mixture inside the prior's support.

        The arguments are those of :meth:`MixtureEstimator.mass`.
        """
        if accept is None or self.is_box:
            # What is inside the bounds before it is moved is inside them after.
            return super().mass(
                x, accept=accept, cache=cache, show_progress_bars=show_progress_bars
            )
        bounded = bool(torch.isfinite(torch.cat([self.low, self.high])).any())
        inside = super().mass(x, accept=self._inside if bounded else None, cache={})
        with seeded(0):
            draws = self.sample(torch.Size((LEAKAGE_DRAWS,)), x)
        kept = accept(draws.flatten(0, 1)).reshape(draws.shape[:2]).double()
        share = kept.mean(dim=0)
        error = (share * (1 - share) / LEAKAGE_DRAWS).sqrt()
        return Leakage(inside.mass * share, inside.standard_error + error)

    @torch.no_grad()
    def spread(self, x: Tensor) -> Spread:
        """Return the map of each observation."""
        with seeded(0):
            draws = super().sample(torch.Size((NUM_DRAWS,)), x, accept=self._inside)
        centre = to_line(draws.double(), self.low, self.high).mean(dim=0)
        return Spread(centre, self.factors, self.low, self.high)

    def _inside(self, theta: Tensor) -> Tensor:
        return ((theta >= self.low) & (theta <= self.high)).all(dim=-1)
