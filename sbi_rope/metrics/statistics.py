"""Weighted means over calibration pairs with their errors, and a test of two sets."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from scipy.stats import t as student
from torch import Tensor

from sbi_rope.data.pairs import effective_number, group_means, one_of_each_group
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.tensors import divisors

# Two sets differ clearly if the p-value is below this.
LEVEL = 0.01
NUM_DIVISIONS = 999
# With fewer rows in one of the sets, no difference could be significant. The cost
# grows with the square of the number of rows.
FEWEST, MOST = 5, 500
# Draws that an estimate of NPE is the mean of.
NUM_FOR_ESTIMATE = 20
# What is further from the median, in standard deviations of a normal distribution that
# has the same quartiles, counts as being this far away.
FARTHEST = 10.0


@dataclass(frozen=True)
class Estimate:
    """A mean with the ends of its interval, which are NaN for a single value.

    Formatting applies to all three numbers.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan

    @classmethod
    def of(
        cls,
        values: Tensor,
        weight: Tensor | None = None,
        group: Tensor | None = None,
        *,
        confidence: float = 0.95,
    ) -> "Estimate":
        r"""Return a weighted mean and its interval of Student's t over groups.

        .. math:: \bar v \pm t_{n-1} \sqrt{\frac{n}{n - 1}
            \frac{\sum_g w_g^2 (v_g - \bar v)^2}{(\sum_g w_g)^2}}, \qquad
            n = \frac{(\sum_g w_g)^2}{\sum_g w_g^2}

        Values, weights and groups have shape ``(n,)``. NaN is left out, and the
        interval has no ends if a value is infinite. Weights are one each if None. The
        interval takes the means of groups for independent; all pairs are if None.

        Example:
            >>> print(f"{Estimate.of(torch.tensor([1.0, 2.0, 3.0])):.2f}")
            2.00 (-0.48 to 4.48)
        """
        known = ~values.isnan()
        values = values[known].double()
        weight = torch.ones_like(values) if weight is None else weight[known].double()
        if group is not None:
            values, weight = group_means(values, weight, group[known])
        mean = float((weight * values).sum() / weight.sum())
        if torch.isinf(values).any():
            return cls(mean, -math.inf, math.inf)
        if len(values) < 2:
            return cls(mean)
        n = max(2.0, effective_number(weight))
        square = (weight * (values - mean)).square().sum() / weight.sum().square()
        reach = student.ppf((1 + confidence) / 2, n - 1)
        half = float(reach * (square * n / (n - 1)).sqrt())
        return cls(mean, mean - half, mean + half)

    def __format__(self, spec: str) -> str:
        if math.isnan(self.low):
            return format(self.mean, spec)
        low, high = format(self.low, spec), format(self.high, spec)
        return f"{format(self.mean, spec)} ({low} to {high})"

    def __str__(self) -> str:
        return format(self, ".3g")


@dataclass(frozen=True, kw_only=True)
class TwoSampleTest:
    """The outcome of a permutation test of two sets.

    Attributes:
        p_value: The share of random divisions of all rows into two sets that differ at
            least as much as the two sets, in the embeddings or in an estimate.
        p_values: The same share for each parameter alone, with the divisions that
            differ as much in any respect, ``(d,)``.
        spreads: The standard deviation of the estimates of each parameter in the second
            set, as a multiple of that in the first, ``(d,)``.
    """

    p_value: float
    p_values: tuple[float, ...] = ()
    spreads: tuple[float, ...] = ()

    @property
    def is_different(self) -> bool:
        """Whether the two sets differ clearly, with a p-value below 0.01."""
        return self.p_value < LEVEL

    def parameters(self, names: Sequence[str]) -> list[str]:
        """Say which parameters differ by themselves, and how."""
        ratios = zip(names, self.p_values, self.spreads, strict=True)
        return [
            f"{name} ({spread:.2g} times the spread of the pairs)"
            for name, p_value, spread in ratios
            if p_value < LEVEL
        ]


@torch.no_grad()
def compare_with_pairs(
    labelled: Tensor, groups: Tensor, batch: Tensor, density: Any
) -> TwoSampleTest | None:
    r"""Test whether a batch is like the observations of calibration pairs.

    The statistic is the energy distance
    :math:`2\,E\|X - Y\| - E\|X - X'\| - E\|Y - Y'\|`, which is zero only if the two
    distributions are the same. It is computed of the embeddings ``(n, l)`` and
    ``(m, l)``, and of the estimates of each parameter alone by ``density``,
    :math:`q(\theta \mid h)`, which show a narrower or a shifted range of one of them.
    Each of these distances is divided by its mean over random divisions of all rows,
    and the largest counts.

    Each column is divided by its standard deviation in both sets together. Entries that
    are far from all others are moved closer first. Otherwise a single one could hide
    that the sets differ. Pairs of one group, ``(n,)``, resemble each other, so that one
    of them is used. At most 500 random rows of each set are used.

    The outcome is always the same for the same sets. It is None if one of the sets has
    fewer than five rows.

    References:
        | Testing for Equal Distributions in High Dimension (Szekely and Rizzo, 2004)
    """
    first = labelled[one_of_each_group(groups, seed=0).to(labelled.device)]
    if min(len(first), len(batch)) < FEWEST:
        return None
    with seeded(0):
        first, second = (
            some[torch.randperm(len(some))[:MOST]] for some in (first, batch)
        )
        rows, n, m = torch.cat([first, second]), len(first), len(second)
        member = torch.zeros(NUM_DIVISIONS + 1, n + m, dtype=torch.double)
        member[0, :n] = 1.0
        for i in range(1, NUM_DIVISIONS + 1):
            member[i, torch.randperm(n + m)[:n]] = 1.0
        draws = torch.Size((NUM_FOR_ESTIMATE,))
        estimates = density.sample(draws, condition=rows).mean(dim=0)
    # Far from all simulations, a network may return anything.
    estimates = estimates.cpu().double().nan_to_num()
    compared = [rows.cpu().double(), *estimates.T[..., None]]
    # The energy distances of each division, and how much larger than usual they are.
    energies = torch.stack([_energies(_closer(one), member) for one in compared], dim=1)
    excess = energies / divisors(energies.mean(dim=0))
    largest = excess.amax(dim=1)
    # A division that is equal up to rounding counts, and so does the one at hand.
    reached = largest[:, None] >= excess[0] - 1e-9
    each = reached.double().mean(dim=0).tolist()
    of_sets = [column.split([n, m]) for column in estimates.T]
    return TwoSampleTest(
        p_value=min(each),
        p_values=tuple(each[1:]),
        spreads=tuple(float(b.std() / divisors(a.std())) for a, b in of_sets),
    )


def _energies(rows: Tensor, member: Tensor) -> Tensor:
    """Return the energy distance of each division of rows ``(n + m, l)``.

    In ``member``, ``(divisions, n + m)``, the first set of each division has ones.
    """
    # Of two equal rows, only rounding would be left to compare.
    std = rows.std(dim=0)
    varies = std > 1e-9 * rows.abs().amax(dim=0).clamp_min(1e-30)
    rows = (rows - rows.mean(dim=0))[:, varies] / std[varies]
    distances = torch.cdist(rows, rows)
    n = int(member[0].sum())
    rest, m = 1.0 - member, len(rows) - n
    # Mean distances within the first set, across, and within the second.
    of_first = member @ distances
    of_second = distances.sum(dim=1) - of_first
    within = (of_first * member).sum(dim=1) / n**2
    across = (of_first * rest).sum(dim=1) / (n * m)
    other = (of_second * rest).sum(dim=1) / m**2
    return 2 * across - within - other


def _closer(rows: Tensor) -> Tensor:
    """Move entries that are far from the median of their column closer to it."""
    low, median, high = rows.quantile(rows.new_tensor([0.25, 0.5, 0.75]), dim=0)
    reach = FARTHEST * (high - low) / 1.349
    reach = reach.where(reach > 0, torch.inf)  # most entries of the column are equal
    return rows.clamp(median - reach, median + reach)
