"""An interval for each parameter given one observation, or given each of a batch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError
from sbi_rope.sets.guarantee import Guarantee
from sbi_rope.settings import default_names, names_of
from sbi_rope.tensors import as_batch, as_numbers

__all__ = ["CredibleIntervals", "central_intervals"]


# So many intervals are printed.
MAX_PRINTED = 20


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

    @classmethod
    def joined(cls, parts: "Sequence[CredibleIntervals]") -> "CredibleIntervals":
        """Put the intervals of several batches together."""
        return replace(
            parts[0],
            low=torch.cat([part.low for part in parts]),
            high=torch.cat([part.high for part in parts]),
        )

    @property
    def is_guaranteed(self) -> bool:
        """Whether there is a guarantee."""
        return self.guarantee is not None

    def __getitem__(self, index: int | slice) -> "CredibleIntervals":
        """Return the intervals of one observation of a batch, or of several.

        Raises:
            InvalidInputError: If these are the intervals of one observation.
        """
        if not self._is_batch:
            raise InvalidInputError(
                "Expected intervals of a batch; got those of one observation."
            )
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

        Raises:
            InvalidInputError: If the shape does not fit, or a number is not finite.
        """
        event = self.low.shape
        theta = as_numbers("theta", theta, names=self.parameter_names)
        shape = theta.shape
        rows = theta[None] if theta.ndim == len(event) else theta
        if rows.ndim > len(event):
            rows = rows.flatten(0, rows.ndim - 1 - len(event))
        rows = as_batch("theta", rows, event).to(self.low)
        return ((self.low <= rows) & (rows <= self.high)).reshape(shape)

    def as_rows(
        self, parameter_names: Sequence[str] | None = None
    ) -> list[dict[str, Any]]:
        """Return a row for each parameter: its name, and the ends of its interval.

        The rows of a batch also hold the number of the observation, from 0.

        Args:
            parameter_names: A name for each parameter. If None, those that ``RoPE`` was
                given, or "theta_1" and so on.

        Raises:
            InvalidInputError: If the names do not fit.
        """
        count = self.low.shape[-1]
        names = self.parameter_names or default_names(count)
        if parameter_names is not None:
            names = names_of(parameter_names, count)
        if self._is_batch:
            return [
                {"observation": number, **row}
                for number in range(len(self.low))
                for row in self[number].as_rows(names)
            ]
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
    """Return the central interval of each parameter given each observation.

    Args:
        posterior: A posterior with ``sample_batched``.
        level: The probability of each interval under the posterior.
        x: The observations, shape ``(B, *event)``.
        num_samples: The number of draws.
    """
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
