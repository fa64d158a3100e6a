"""The discrepancy between a simulator and reality, summary by summary."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy.correction import in_units
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.utils.errors import InvalidInputError

NUM_DRAWS = 4000


@dataclass(frozen=True)
class Interval:
    """The median of an estimate, with the ends of its 95 % interval."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, draws: Tensor) -> "Interval":
        """Return the quantiles of draws, shape ``(m,)``."""
        return cls(*draws.quantile(draws.new_tensor([0.5, 0.025, 0.975])).tolist())

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
            :math:`E[(b + (a - 1)(x_s - \bar x))^2] + s^2`, in units of ``std``.
        probability_of_none: The probability that the simulator is right about this
            summary, with one half before any pair is seen.
        std: The standard deviation of simulations from the prior, in the units of x.
    """

    name: str
    gain: Interval
    shift: Interval
    error: Interval
    size: Interval
    probability_of_none: float
    std: float

    @property
    def is_off(self) -> bool:
        """Whether a discrepancy is more probable than none."""
        return self.probability_of_none < 0.5


@dataclass(frozen=True, kw_only=True)
class DiscrepancyReport:
    """The discrepancy of each summary, as estimated from calibration pairs.

    Print it, or draw it with :func:`sbi_rope.plots.discrepancy`.

    Attributes:
        summaries: The discrepancy of each summary, from the largest to the smallest.
            Summaries without a sign of discrepancy are last.
        num_pairs: The number of calibration pairs.
        num_groups: The number of people or specimens that they are of.
        constant: The names of summaries that are the same in all simulations.
    """

    summaries: tuple[SummaryDiscrepancy, ...]
    num_pairs: int
    num_groups: int
    constant: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> SummaryDiscrepancy:
        return {summary.name: summary for summary in self.summaries}[name]

    def renamed(self, names: Sequence[str]) -> "DiscrepancyReport":
        """Return the report of numbered summaries with names, in the order of x."""
        of_entry = {f"x[{j}]": name for j, name in enumerate(names)}
        count = len(self.summaries) + len(self.constant)
        if not count == len(names) == len(set(names)):
            raise InvalidInputError(
                f"Expected `x_names` to be {count} different names; got {list(names)}."
            )
        return replace(
            self,
            summaries=tuple(replace(s, name=of_entry[s.name]) for s in self.summaries),
            constant=tuple(of_entry[name] for name in self.constant),
        )

    def __str__(self) -> str:
        grouped = self.num_groups < self.num_pairs
        in_groups = f" in {self.num_groups} groups" if grouped else ""
        off = [one for one in self.summaries if one.is_off]
        fine = [one.name for one in self.summaries if not one.is_off]
        lines = [
            f"What {self.num_pairs} calibration pairs{in_groups} say about the "
            "simulator",
            "  observed = mean + shift + gain (simulated - mean) + error",
            "  95 % intervals; size in standard deviations of simulations, shift and "
            "error in units of x",
        ]
        if off:
            names = ("name", "size", "shift", "gain", "error")
            rows = [[str(getattr(one, name)) for name in names] for one in off]
            rows.insert(0, ["summary", *names[1:]])
            widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
            cells = (map(str.ljust, row, widths) for row in rows)
            lines += ["  " + "  ".join(row).rstrip() for row in cells]
        if fine:
            lines.append(f"  no sign of discrepancy: {', '.join(fine)}")
        if self.constant:
            lines.append(f"  The same in all simulations: {', '.join(self.constant)}.")
        return "\n".join(lines)


def report_discrepancy(
    x: Tensor,
    moments: Moments,
    simulated: Tensor,
    *,
    model: DiscrepancyModel,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
) -> DiscrepancyReport:
    """Fit the discrepancy of each summary of x ``(n, l)`` separately.

    A joint gain of summaries that depend on each other, such as two sensors of one
    light, is ambiguous. The gain of a single summary is not, and can be checked.
    """
    unit = Standardisation(simulated.double())
    varying, constant = ((unit.varies == value).nonzero()[:, 0] for value in (1, 0))
    z, expected, summaries = unit(x.double()), in_units(moments, unit), []
    for k, j in enumerate(varying.tolist()):
        noise = expected.covariance[:, k, k].mean().reshape(1, 1)
        mean = expected.means[..., [k]]
        found = model.fit(z[:, [k]], mean, noise, weights=weights, groups=groups)
        # Intervals assume that there is a discrepancy, whose probability is beside.
        draws = replace(found, probability_of_none=0.0).sample(
            NUM_DRAWS, smallest_error=0.0, seed=0
        )
        gain, shift = draws.gain[:, 0, 0], draws.offset[:, 0]
        error, std = draws.error_factor[:, 0, 0].abs(), float(unit.std[j])
        size = ((gain - 1).square() + shift.square() + error.square()).sqrt()
        summaries.append(
            SummaryDiscrepancy(
                name=f"x[{j}]",
                gain=Interval.of(gain),
                shift=Interval.of(shift * std),
                error=Interval.of(error * std),
                size=Interval.of(size),
                probability_of_none=found.probability_of_none,
                std=std,
            )
        )
    summaries.sort(key=lambda s: (not s.is_off, -s.size.median))
    return DiscrepancyReport(
        summaries=tuple(summaries),
        num_pairs=len(x),
        num_groups=len(x) if groups is None else len(groups.unique()),
        constant=tuple(f"x[{j}]" for j in constant.tolist()),
    )
