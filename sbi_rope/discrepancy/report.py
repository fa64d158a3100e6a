"""The discrepancy between a simulator and reality, summary by summary."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope._progress import progress_bar
from sbi_rope._standardisation import Standardisation
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.errors import InvalidInputError
from sbi_rope.moments import Moments

__all__ = [
    "DiscrepancyReport",
    "Interval",
    "SummaryDiscrepancy",
    "report_discrepancy",
    "what_groups_count_as",
    "what_outliers_mean",
]

NUM_DRAWS = 4000
# A progress bar appears after this many seconds.
DELAY = 2.0
# The probability that a summary without outliers is reported to have one.
FALSE_ALARMS = 0.01
# The efficiency of a standard deviation that is estimated from a median distance.
EFFICIENCY = 0.37
# With fewer pairs one cannot tell which of them is the outlier.
MIN_PAIRS_FOR_OUTLIERS = 10
# If this share of the pairs are outliers, they are hardly all mistakes of labelling.
MANY_OUTLIERS = 0.05


@dataclass(frozen=True, kw_only=True)
class Interval:
    """An estimate with its 95 % interval.

    Attributes:
        median: The estimate.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, draws: Tensor) -> "Interval":
        """Return the quantiles of draws, shape ``(m,)``."""
        levels = torch.tensor([0.025, 0.5, 0.975]).to(draws)
        low, median, high = draws.quantile(levels).tolist()
        return cls(median=median, low=low, high=high)

    def __str__(self) -> str:
        return f"{self.median:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True, kw_only=True)
class SummaryDiscrepancy:
    r"""How one summary of real observations differs from simulated ones.

    .. math::
        x_o = \bar x + b + a (x_s - \bar x) + e, \qquad e \sim \mathcal N(0, s^2),

    with :math:`\bar x` the mean of simulations from the prior.

    Attributes:
        name: Name of the summary.
        gain: a, without a unit.
        shift: b, in the units of x.
        error: s, in the units of x. It comes in addition to the simulator's noise.
        size: Typical difference between a simulation and its correction, the root of
            :math:`E[(b + (a - 1)(x_s - \bar x))^2] + s^2`, in standard deviations of
            simulations from the prior.
        probability_of_none: The probability that the simulator is right about this
            summary, with one half before any pair is seen.
        outliers: Rows of calibration pairs that do not fit the others. In 99 of 100
            summaries without outliers no pair is so far away by chance.
        std: The standard deviation of simulations from the prior, in the units of x;
            one if it is not known.
        num_independent: How many independent pairs the calibration pairs count as here,
            see :class:`~sbi_rope.discrepancy.DiscrepancyModel`; None if not known.
    """

    name: str
    gain: Interval
    shift: Interval
    error: Interval
    size: Interval
    probability_of_none: float
    outliers: tuple[int, ...] = ()
    std: float = 1.0
    num_independent: float | None = None

    @property
    def is_off(self) -> bool:
        """Whether a discrepancy is more probable than none."""
        return self.probability_of_none < 0.5


@dataclass(frozen=True, kw_only=True)
class DiscrepancyReport:
    """The discrepancy of each summary, as estimated from calibration pairs.

    Print it, or use :meth:`as_rows` and :func:`sbi_rope.plots.discrepancy`.

    Attributes:
        summaries: The discrepancy of each summary, from the largest to the smallest.
            Summaries without a sign of discrepancy are last.
        num_pairs: The number of calibration pairs.
        num_groups: The number of people or specimens that they are of; None if there
            are as many as pairs.
        constant: The names of summaries that are the same in all simulations. Nothing
            can be said about them.
    """

    summaries: tuple[SummaryDiscrepancy, ...]
    num_pairs: int
    constant: tuple[str, ...] = ()
    num_groups: int | None = None

    def __getitem__(self, name: str) -> SummaryDiscrepancy:
        return {summary.name: summary for summary in self.summaries}[name]

    @property
    def _in_groups(self) -> str:
        return "" if self.num_groups is None else f" in {self.num_groups} groups"

    def renamed(self, names: Sequence[str]) -> "DiscrepancyReport":
        """Return the same report with other names of the summaries.

        Args:
            names: A name for each entry of x, in the order of x.

        Raises:
            InvalidInputError: If they are not one for each entry of x, or the report
                has names already.
        """
        of_entry = {f"x[{j}]": name for j, name in enumerate(names)}
        known = {*(summary.name for summary in self.summaries), *self.constant}
        if known != set(of_entry):
            raise InvalidInputError(
                f"Expected `names` of {sorted(known)}; got {list(names)}."
            )
        return replace(
            self,
            summaries=tuple(
                replace(summary, name=of_entry[summary.name])
                for summary in self.summaries
            ),
            constant=tuple(of_entry[name] for name in self.constant),
        )

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each summary, in the order of ``summaries``."""
        rows = []
        for summary in self.summaries:
            row: dict[str, Any] = {"summary": summary.name}
            for name in ("size", "shift", "gain", "error"):
                interval: Interval = getattr(summary, name)
                row |= {
                    name: interval.median,
                    f"{name}_low": interval.low,
                    f"{name}_high": interval.high,
                }
            row["probability_of_none"] = summary.probability_of_none
            row["outliers"] = list(summary.outliers)
            row["num_independent"] = summary.num_independent
            rows.append(row)
        return rows

    def __str__(self) -> str:
        off = [summary for summary in self.summaries if summary.is_off]
        fine = [summary.name for summary in self.summaries if not summary.is_off]
        lines = [
            f"What {self.num_pairs} calibration pairs{self._in_groups} say about the "
            "simulator",
            "  observed = mean + shift + gain (simulated - mean) + error",
        ]
        if off:
            lines.append(
                "  95 % intervals; size in standard deviations of simulations, shift "
                "and error in units of x"
            )
            lines += _table(off)
        if fine:
            lines.append(f"  no sign of discrepancy: {', '.join(fine)}")
        if self.constant:
            lines.append(f"  the same in all simulations: {', '.join(self.constant)}")
        if counted := what_groups_count_as(self):
            lines.append(f"  {counted}")
        outliers: dict[int, list[str]] = {}
        for summary in self.summaries:
            for row in summary.outliers:
                outliers.setdefault(row, []).append(summary.name)
        if outliers:
            listed = (f"row {row} ({', '.join(n)})" for row, n in outliers.items())
            lines.append(
                f"  pairs that do not fit the others: {'; '.join(listed)}. "
                f"{what_outliers_mean(len(outliers), self.num_pairs)}"
            )
        return "\n".join(lines)


def what_groups_count_as(report: DiscrepancyReport) -> str:
    """Say how many independent pairs those of a report count as; "" without groups."""
    numbers = [s.num_independent for s in report.summaries if s.num_independent]
    if report.num_groups is None or not numbers:
        return ""
    least, most = f"{min(numbers):.0f}", f"{max(numbers):.0f}"
    count = least if least == most else f"{least} to {most}"
    return (
        "Pairs of a group can have errors in common. Here, the "
        f"{report.num_pairs} pairs count as {count} independent ones."
    )


def what_outliers_mean(count: int, num_pairs: int) -> str:
    """Say what pairs that do not fit the others may be a sign of."""
    if count > max(2.0, MANY_OUTLIERS * num_pairs):
        return (
            "So many suggest that reality is not linear in the simulation there, "
            "rather than that labels are wrong."
        )
    return (
        "Look whether a label or a measurement is wrong, or whether reality is not "
        "linear in the simulation there."
    )


def _table(summaries: Sequence[SummaryDiscrepancy]) -> list[str]:
    heads = ("summary", "size", "shift", "gain", "error")
    rows = [heads] + [
        (s.name, str(s.size), str(s.shift), str(s.gain), str(s.error))
        for s in summaries
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(heads))]
    return [
        "  " + "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def report_discrepancy(
    x: Tensor,
    moments: Moments,
    simulated: Tensor,
    *,
    model: DiscrepancyModel,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
    x_names: Sequence[str] | None = None,
    seed: int = 0,
    show_progress_bars: bool = False,
) -> DiscrepancyReport:
    """Fit the discrepancy of each summary separately.

    A joint gain of summaries that depend on each other, such as two sensors of one
    light, is ambiguous. The gain of a single summary is not, and can be checked.

    Args:
        x: Real observations of the calibration pairs, shape ``(n, l)``.
        moments: The moments of simulations at their parameters.
        simulated: Simulations from the prior, shape ``(n_s, l)``.
        model: The model of the discrepancy.
        weights: How many pairs each pair counts as, shape ``(n,)``; one if None.
        groups: A number for each pair, the same for recordings of one person or
            specimen, whose errors can have something in common; None if all differ.
        x_names: Names of the summaries; numbered if None.
        seed: Seed of the draws behind the intervals.
        show_progress_bars: Whether to show the progress if there are many summaries.

    Raises:
        InvalidInputError: If there are not as many names as summaries.
    """
    width = x.shape[1]
    names = [f"x[{j}]" for j in range(width)] if x_names is None else list(x_names)
    if len(names) != width or len(set(names)) != width:
        raise InvalidInputError(
            f"Expected `x_names` to be {width} different names; got {names}."
        )
    standardisation = Standardisation(simulated.double())
    varies = standardisation.varies.tolist()
    summaries = []
    numbers = range(width)
    for j in progress_bar(
        numbers, show=show_progress_bars, desc="Summaries", delay=DELAY
    ):
        if not varies[j]:
            continue
        mean, std = standardisation.mean[j], standardisation.std[j]
        z = ((x[:, j].double() - mean) / std)[:, None]
        m = ((moments.means[..., j] - mean) / std)[..., None]
        noise = moments.covariance[:, j, j].mean() / std.square()
        discrepancy = model.fit(
            z, m, noise.reshape(1, 1), weights=weights, groups=groups
        )
        summaries.append(
            _summary(names[j], discrepancy, z, m, scale=float(std), seed=seed)
        )
    if not summaries:
        raise InvalidInputError(
            "Expected simulations that differ from each other; all summaries are "
            "constant."
        )
    return DiscrepancyReport(
        summaries=tuple(
            sorted(summaries, key=lambda s: (not s.is_off, -s.size.median))
        ),
        num_pairs=len(x),
        num_groups=_num_groups(groups),
        constant=tuple(n for n, v in zip(names, varies, strict=True) if not v),
    )


def _num_groups(groups: Tensor | None) -> int | None:
    if groups is None or (number := len(groups.unique())) == len(groups):
        return None
    return number


def _summary(
    name: str,
    discrepancy: Discrepancy,
    z: Tensor,
    mean: Tensor,
    *,
    scale: float,
    seed: int,
) -> SummaryDiscrepancy:
    """Return the discrepancy of one summary, with z ``(n, 1)`` and mean ``(n, R, 1)``.

    Where labels are not exact there are no outliers: a residual may come from the
    label.
    """
    # The intervals assume that there is a discrepancy. Its probability is reported too.
    draws = replace(discrepancy, probability_of_none=0.0).sample(
        NUM_DRAWS, smallest_error=0.0, seed=seed
    )
    gain, shift = draws.gain[:, 0, 0], draws.offset[:, 0]
    error = draws.error_factor[:, 0, 0].abs()
    size = ((gain - 1).square() + shift.square() + error.square()).sqrt()
    outliers: tuple[int, ...] = ()
    if mean.shape[1] == 1:
        residual = (z - gain.median() * mean[:, 0] - shift.median())[:, 0]
        noise = float(gain.median().abs() * discrepancy.noise[0, 0].sqrt())
        outliers = _outliers(residual, noise)
    return SummaryDiscrepancy(
        name=name,
        gain=Interval.of(gain),
        shift=Interval.of(shift * scale),
        error=Interval.of(error * scale),
        size=Interval.of(size),
        probability_of_none=discrepancy.probability_of_none,
        outliers=outliers,
        std=scale,
        num_independent=discrepancy.num_independent,
    )


def _outliers(residual: Tensor, noise: float) -> tuple[int, ...]:
    """Return the rows of outliers; their standard deviation is at least ``noise``."""
    n = len(residual)
    if n < MIN_PAIRS_FOR_OUTLIERS:
        return ()
    distance = (residual - residual.median()).abs()
    # The median distance of a normal variable from its median is 0.6745 standard
    # deviations.
    std = (distance.median() / 0.6745).clamp_min(noise)
    return tuple((distance > _furthest(n) * std).nonzero().flatten().tolist())


def _furthest(n: int) -> float:
    """Return the distance that the furthest of n values exceeds with 1 % probability.

    The unit is the standard deviation. Because this is an estimate, the distribution is
    a Student t and not a normal one. Its quantile is computed by Wallace's
    approximation.
    """
    level = torch.tensor(1 - FALSE_ALARMS / (2 * n), dtype=torch.double)
    freedom = EFFICIENCY * (n - 1)
    score = float(torch.special.ndtri(level)) * (8 * freedom + 3) / (8 * freedom + 1)
    return math.sqrt(freedom * math.expm1(score**2 / freedom))
