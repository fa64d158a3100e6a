"""A set of parameters, or an interval for each, given one observation or several."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError
from sbi_rope.sets.conformal import DIGITS, Guarantee
from sbi_rope.settings import default_names
from sbi_rope.tensors import as_batch, as_numbers

__all__ = [
    "CredibleIntervals",
    "CredibleSet",
    "HighestDensity",
    "central_intervals",
    "highest_density_set",
]

# So many intervals are printed.
MAX_PRINTED = 20


# Sets ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class CredibleSet:
    r"""A set of parameters that are credible given one observation.

    ``posterior.credible_set`` makes it. Without a guarantee it is the set of highest
    density, :math:`\{\theta: \log p(\theta \mid x) \ge t\}`, with a probability of
    ``level`` under the posterior. It holds the true parameters this often only
    if the posterior is calibrated. A set with a guarantee is described in
    :class:`~sbi_rope.sets.Guarantee`.

    Attributes:
        level: The level that was asked for.
        volume: The volume, in the units of the parameters.
        volume_error: The Monte-Carlo standard error of ``volume``.
        volume_z: The volume in standard deviations of the prior,
            :math:`V / \prod_j s_j`. NaN if the prior has none.
        guarantee: The guarantee; None if there is none.
        draws: The parameters that the volume was estimated from, shape ``(m, d)``.
        inside: Which of the draws are in the set, shape ``(m,)``.
        rule: What tells which parameters ``(n, d)`` are in the set, by ``contains``.
        parameter_names: One name for each parameter; None if they have none.
    """

    level: float
    volume: float
    volume_error: float
    volume_z: float
    guarantee: Guarantee | None
    draws: Tensor = field(repr=False)
    inside: Tensor = field(repr=False)
    rule: Any = field(repr=False)
    parameter_names: tuple[str, ...] | None = None

    @classmethod
    def of(
        cls,
        rule: Any,
        draws: Tensor,
        log_density: Tensor,
        *,
        level: float,
        log_unit: float,
        guarantee: Guarantee | None = None,
    ) -> "CredibleSet":
        r"""Measure the set A of a rule, by importance sampling.

        .. math:: V = \frac1m \sum_k \frac{\mathbf{1}[\theta_k \in A]}{q(\theta_k)}

        The draws :math:`\theta_k` of q reach all of the set, shape ``(m, d)``, and
        ``log_density`` is :math:`\log q`, shape ``(m,)``. ``log_unit`` is the sum of
        the logs of the prior's standard deviations.
        """
        inside = rule.contains(draws)
        terms = torch.where(inside, torch.exp(-log_density.double()), 0.0)
        volume = float(terms.mean())
        return cls(
            level=level,
            volume=volume,
            volume_error=float(terms.std() / len(terms) ** 0.5),
            volume_z=volume * math.exp(-log_unit),
            guarantee=guarantee,
            draws=draws,
            inside=inside,
            rule=rule,
        )

    @torch.no_grad()
    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters ``(*batch, d)`` are in the set, shape ``(*batch)``."""
        theta = as_numbers("theta", theta, names=self.parameter_names)
        shape = theta.shape[:-1]
        rows = theta[None] if theta.ndim < 2 else theta.flatten(0, -2)
        rows = as_batch("theta", rows, self.draws.shape[1:]).to(self.draws)
        return self.rule.contains(rows).reshape(shape)

    def __str__(self) -> str:
        count, unit = self.draws.shape[1], ""
        if not math.isnan(self.volume_z):
            unit = f", or {self.volume_z:.3g} in standard deviations of the prior"
        promise = self.guarantee or (
            "It has no guarantee: it holds the true parameters this often only if the "
            "posterior is calibrated."
        )
        return (
            f"The {100 * self.level:.4g} % set of {count} "
            f"parameter{'s' * (count > 1)} has a volume of {self.volume:.3g} +- "
            f"{self.volume_error:.1g}{unit}.\n{promise}"
        )

    __repr__ = __str__  # which notebooks show


@dataclass(frozen=True, eq=False, kw_only=True)
class HighestDensity:
    """The parameters whose log density given x is at least a threshold."""

    posterior: Any
    x: Tensor
    threshold: float

    def contains(self, theta: Tensor) -> Tensor:
        """Return whether parameters ``(n, d)`` are in the set, shape ``(n,)``."""
        return self.posterior.log_prob(theta, x=self.x) >= self.threshold


@torch.no_grad()
def highest_density_set(
    posterior: Any, x: Tensor, *, level: float, num_samples: int
) -> CredibleSet:
    r"""Return the set of highest density given one observation.

    Its threshold is the (1 - level) quantile of the log density of the draws. The
    volume is estimated from the same draws, each of which counts
    :math:`1 / p(\theta \mid x)` if it is in the set. This is at most
    :math:`e^{-t}`, so that the variance is finite.
    """
    draws = posterior.sample((num_samples,), x=x, show_progress_bars=False)
    log_prob = posterior.log_prob(draws, x=x)
    left_out = math.floor(round((1 - level) * num_samples, DIGITS))
    threshold = log_prob.sort().values[left_out]
    return CredibleSet.of(
        HighestDensity(posterior=posterior, x=x, threshold=float(threshold)),
        draws,
        log_prob,
        level=level,
        log_unit=float(posterior.prior.log_units().sum()),
    )


# Intervals ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class CredibleIntervals:
    """An interval for each parameter given one observation, or each of a batch.

    ``posterior.credible_intervals`` and ``posterior.credible_intervals_batched`` make
    it. Each interval has the level by itself. All parameters together are inside less
    often. Of a batch, ``intervals[i]`` are those of one observation.

    Attributes:
        low: The lower ends, shape ``(d,)``, or ``(B, d)`` of a batch.
        high: The upper ends, as ``low``.
        level: The level of each interval.
        guarantee: The guarantee of each interval; None if there is none.
        parameter_names: One name for each parameter; None if they have none.
    """

    low: Tensor = field(repr=False)
    high: Tensor = field(repr=False)
    level: float
    guarantee: Guarantee | None
    parameter_names: tuple[str, ...] | None = None

    def __getitem__(self, index: int | slice) -> "CredibleIntervals":
        """Return the intervals of one observation of a batch, or of several."""
        if not self._is_batch:
            raise InvalidInputError("Expected intervals of a batch; got one x.")
        return replace(self, low=self.low[index], high=self.high[index])

    @property
    def _is_batch(self) -> bool:
        return self.low.ndim > 1

    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters are in their intervals, one by one.

        Args:
            theta: Parameters, shape ``(*batch, d)``, or ``(*batch, B, d)`` for
                intervals of a batch.

        Returns:
            The shape of ``theta``, bool.
        """
        event = self.low.shape
        theta = as_numbers("theta", theta, names=self.parameter_names)
        shape = theta.shape
        rows = theta[None] if theta.ndim == len(event) else theta
        if rows.ndim > len(event):
            rows = rows.flatten(0, rows.ndim - 1 - len(event))
        rows = as_batch("theta", rows, event).to(self.low)
        return ((self.low <= rows) & (rows <= self.high)).reshape(shape)

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each parameter: its name, and the ends of its interval.

        The rows of a batch also hold the number of the observation, from 0.
        """
        if self._is_batch:
            return [
                {"observation": number, **row}
                for number in range(len(self.low))
                for row in self[number].as_rows()
            ]
        names = self.parameter_names or default_names(self.low.shape[-1])
        ends = zip(names, self.low.tolist(), self.high.tolist(), strict=True)
        return [{"parameter": name, "low": a, "high": b} for name, a, b in ends]

    def __str__(self) -> str:
        count = -(-MAX_PRINTED // self.low.shape[-1])
        rows = (self[:count] if self._is_batch else self).as_rows()
        lines = [
            (f"  observation {row['observation']}," if self._is_batch else " ")
            + f" {row['parameter']}: {_ends_in_words(row['low'], row['high'])}"
            for row in rows
        ]
        if self._is_batch and len(self.low) > count:
            lines.append(f"  and those of {len(self.low) - count} more observations")
        if self.guarantee is None:
            promise = (
                "They have no guarantee: each holds its true parameter this often only "
                "if the posterior is calibrated."
            )
        else:
            promise = self.guarantee.says("each holds its true parameter")
        if self.low.shape[-1] > 1:
            promise += " All together hold theirs less often."
        return "\n".join(
            [f"{100 * self.level:.4g} % intervals, one by one:", *lines, promise]
        )

    __repr__ = __str__  # which notebooks show


def _ends_in_words(low: float, high: float) -> str:
    """Return both ends, with digits enough to see how wide the interval is."""
    digits, width = 4, high - low
    if math.isfinite(width) and width > 0:
        largest = max(abs(low), abs(high))
        digits = max(digits, 3 + math.floor(math.log10(largest / width)))
    return f"{low:.{digits}g} to {high:.{digits}g}"


@torch.no_grad()
def central_intervals(
    posterior: Any, level: float, x: Tensor, *, num_samples: int
) -> CredibleIntervals:
    """Return the central interval of each parameter given each x, ``(B, *event)``."""
    draws = posterior.sample_batched((num_samples,), x, show_progress_bars=False)
    ordered = draws.sort(dim=0).values.double()
    last = num_samples - 1
    ends = []
    for probability in ((1 - level) / 2, (1 + level) / 2):
        # Not by torch.quantile, which refuses more than 16 million draws.
        start = min(int(probability * last), last - 1)
        share = probability * last - start
        ends.append(torch.lerp(ordered[start], ordered[start + 1], share))
    low, high = (end.to(draws) for end in ends)
    return CredibleIntervals(low=low, high=high, level=level, guarantee=None)
