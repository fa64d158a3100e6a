"""An interval for each parameter given one observation."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sbi_rope._validation import check_batch, check_names, check_tensor
from sbi_rope.sets.guarantee import Guarantee

__all__ = ["CredibleIntervals", "central_intervals"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CredibleIntervals:
    """An interval for each parameter given one observation.

    ``posterior.credible_intervals`` makes it. Each interval has the level by itself.
    All parameters together are inside less often.

    Attributes:
        low: The lower ends, shape ``(d,)``.
        high: The upper ends, shape ``(d,)``.
        level: The level of each interval.
        guarantee: The guarantee of each interval; None if there is none.
    """

    low: Tensor = field(repr=False)
    high: Tensor = field(repr=False)
    level: float
    guarantee: Guarantee | None

    @property
    def is_guaranteed(self) -> bool:
        """Whether there is a guarantee."""
        return self.guarantee is not None

    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters are in their intervals, one by one.

        Args:
            theta: Parameters, shape ``(*batch, d)``.

        Returns:
            Shape ``(*batch, d)``, bool.

        Raises:
            InvalidTypeError: If theta is no tensor of numbers.
            InvalidInputError: If theta has another number of parameters, or is not
                finite.
        """
        shape = check_tensor("theta", theta).shape
        rows = theta[None] if theta.ndim < 2 else theta.flatten(0, -2)
        rows = check_batch("theta", rows, self.low.shape).detach().to(self.low)
        return ((self.low <= rows) & (rows <= self.high)).reshape(shape)

    def as_rows(
        self, parameter_names: Sequence[str] | None = None
    ) -> list[dict[str, Any]]:
        """Return a row for each parameter: its name, and the ends of its interval.

        Args:
            parameter_names: A name for each parameter; "theta_1" and so on if None.

        Raises:
            InvalidInputError: If the names do not fit.
        """
        count = len(self.low)
        names = [f"theta_{k + 1}" for k in range(count)]
        if parameter_names is not None:
            names = check_names("parameter_names", parameter_names, count)
        ends = zip(names, self.low.tolist(), self.high.tolist(), strict=True)
        return [{"parameter": name, "low": a, "high": b} for name, a, b in ends]

    def __str__(self) -> str:
        lines = [
            f"  {row['parameter']}: {row['low']:.4g} to {row['high']:.4g}"
            for row in self.as_rows()
        ]
        promise = self.guarantee or (
            "They have no guarantee: they hold the true parameters as often as the "
            "posterior is calibrated."
        )
        return "\n".join(
            [f"{100 * self.level:.4g} % intervals, one by one:", *lines, str(promise)]
        )


@torch.no_grad()
def central_intervals(
    posterior: Any, x: Tensor, *, level: float, num_samples: int
) -> CredibleIntervals:
    """Return the central interval of each parameter given one observation.

    Args:
        posterior: A posterior with ``sample``.
        x: The observation.
        level: The probability of each interval under the posterior.
        num_samples: The number of draws.
    """
    draws = posterior.sample((num_samples,), x=x, show_progress_bars=False)
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
