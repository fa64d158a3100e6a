"""Whether two sets of observations come from the same distribution."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.data import one_of_each_group

__all__ = ["LEVEL", "TwoSampleTest", "compare_with_pairs", "two_sample_test"]

# Two sets differ clearly if the p-value is below this.
LEVEL = 0.01
NUM_PERMUTATIONS = 999
# With fewer rows in one of the sets, no difference could be significant.
FEWEST = 5
# The cost grows with the square of the number of rows.
MOST = 1000
# What is further from the median, in standard deviations of a normal distribution that
# has the same quartiles, counts as being this far away.
FARTHEST = 10.0


@dataclass(frozen=True, kw_only=True)
class TwoSampleTest:
    """The outcome of a permutation test of two sets.

    Attributes:
        p_value: The share of random divisions of all rows into two sets whose energy
            distance is at least that of the two sets.
        spread: How far apart the rows of the second set are on average, as a multiple
            of the same distance in the first set.
    """

    p_value: float
    spread: float

    @property
    def is_different(self) -> bool:
        """Whether the two sets differ clearly, with a p-value below 0.01."""
        return self.p_value < LEVEL


def compare_with_pairs(
    labelled: Tensor, groups: Tensor, batch: Tensor
) -> TwoSampleTest | None:
    """Test whether a batch is like the observations of calibration pairs.

    Args:
        labelled: The embeddings of the pairs, shape ``(n, l)``.
        groups: A number for each pair, from 0, the same for pairs of one person or
            specimen, shape ``(n,)``. Such pairs resemble each other, so that one of
            them is used, chosen at random.
        batch: The embeddings of the batch, shape ``(m, l)``.

    Returns:
        The outcome, with the pairs as the first set, or None if there are fewer than
        five of either.
    """
    chosen = one_of_each_group(groups, seed=0)
    return two_sample_test(labelled[chosen.to(labelled.device)], batch)


@torch.no_grad()
def two_sample_test(first: Tensor, second: Tensor) -> TwoSampleTest | None:
    r"""Test whether two sets of vectors come from one distribution.

    The statistic is the energy distance
    :math:`2\,E\|X - Y\| - E\|X - X'\| - E\|Y - Y'\|`, which is zero only if the two
    distributions are the same. It sees other means and other spreads alike. Each column
    is divided by its standard deviation in both sets together. Entries that are far
    from all others are moved closer first. Otherwise a single one could hide that the
    sets differ. Among two sets of one distribution, one in a hundred has a p-value
    below 0.01, whatever the distribution.

    References:
        | Testing for Equal Distributions in High Dimension (Szekely and Rizzo, 2004)

    Args:
        first: Shape ``(n, l)``. At most 1000 random rows are used.
        second: Shape ``(m, l)``; the same holds.

    Returns:
        The outcome, which is always the same for the same sets. None if one of the sets
        has fewer than five rows.
    """
    if min(len(first), len(second)) < FEWEST:
        return None
    with seeded(0):
        sets = [
            values.detach().cpu().double()[torch.randperm(len(values))[:MOST]]
            for values in (first, second)
        ]
        rows, n = _closer(torch.cat(sets)), len(sets[0])
        # Of two equal embeddings, only rounding would be left to compare.
        std = rows.std(dim=0)
        varies = std > 1e-9 * rows.abs().amax(dim=0).clamp_min(1e-30)
        rows = (rows - rows.mean(dim=0))[:, varies] / std[varies]
        distances = torch.cdist(rows, rows)
        member = torch.zeros(NUM_PERMUTATIONS + 1, len(rows), dtype=torch.double)
        member[0, :n] = 1.0
        for i in range(1, NUM_PERMUTATIONS + 1):
            member[i, torch.randperm(len(rows))[:n]] = 1.0
    within, across, other = _mean_distances(distances, member)
    energy = 2 * across - within - other
    # A division that is equal up to rounding counts, and so does the one at hand.
    reached = energy >= energy[0] - 1e-9 * across[0]
    m = len(rows) - n
    return TwoSampleTest(
        p_value=float(reached.double().mean()),
        spread=_ratio(other[0] * m / (m - 1), within[0] * n / (n - 1)),
    )


def _closer(rows: Tensor) -> Tensor:
    """Move entries that are far from the median of their column closer to it."""
    low, median, high = rows.quantile(rows.new_tensor([0.25, 0.5, 0.75]), dim=0)
    reach = FARTHEST * (high - low) / 1.349
    reach = reach.where(reach > 0, torch.inf)  # most entries of the column are equal
    return rows.clamp(median - reach, median + reach)


def _mean_distances(distances: Tensor, member: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean distances within the first set, across, and within the second."""
    rest = 1.0 - member
    n, m = member[0].sum(), rest[0].sum()
    of_first = member @ distances
    of_second = distances.sum(dim=1) - of_first
    return (
        (of_first * member).sum(dim=1) / n**2,
        (of_first * rest).sum(dim=1) / (n * m),
        (of_second * rest).sum(dim=1) / m**2,
    )


def _ratio(value: Tensor, unit: Tensor) -> float:
    return float(value / unit) if unit > 0 else float("inf" if value > 0 else "nan")
