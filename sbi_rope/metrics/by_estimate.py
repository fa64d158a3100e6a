r"""Whether the calibration of a posterior depends on what it estimates.

Coverage that is right on average can be wrong for small and for large parameters. Let
:math:`u` be the rank of the true parameter among samples of the posterior. Given the
observation, :math:`u` is uniform if the posterior is calibrated, so that it is
independent of everything that is computed from the observation, such as the posterior
mean.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from scipy.stats import rankdata
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._statistics import means_of_pairs, permutation_test
from sbi_rope.data import Counts
from sbi_rope.metrics.calibration import (
    ROUNDING,
    random_ranks,
    read_unit_interval,
)
from sbi_rope.settings import Level, check, default_names
from sbi_rope.tensors import as_batch

__all__ = [
    "CoverageByEstimate",
    "coverage_by_estimate",
    "estimates_and_ranks",
    "in_words",
]

# The chance that one of the parameters of a calibrated posterior is called dependent.
LEVEL = 0.05
NUM_PARTS = 3
# With fewer observations that are independent, nothing could be significant.
FEWEST = 10


@dataclass(frozen=True, eq=False, kw_only=True)
class CoverageByEstimate:
    """The coverage of central intervals where estimates are low, middling and high.

    Print it to see what was found.

    Attributes:
        level: The level of the intervals.
        shares: The share of true parameters inside their intervals, for the lowest, the
            middle and the highest third of the posterior means, shape ``(d, 3)``. NaN
            if nothing is known.
        above: The share of true parameters above the posterior's median in each third,
            shape ``(d, 3)``. It is about one half if the posterior is calibrated.
        edges: The posterior means that divide the thirds, shape ``(d, 2)``.
        p_values: The p-value of each parameter, see :func:`coverage_by_estimate`. NaN
            if there are fewer than ten observations.
        estimates: The posterior means, shape ``(n, d)``.
        ranks: The ranks of the true parameters, shape ``(n, d)``.
    """

    level: float
    shares: Tensor = field(repr=False)
    above: Tensor = field(repr=False)
    edges: Tensor = field(repr=False)
    p_values: tuple[float, ...]
    estimates: Tensor = field(repr=False)
    ranks: Tensor = field(repr=False)

    @property
    def num_tested(self) -> int:
        """The number of parameters with a p-value."""
        return sum(not math.isnan(p_value) for p_value in self.p_values)

    @property
    def depends(self) -> tuple[bool, ...]:
        """Whether the coverage of each parameter clearly depends on its estimate.

        Of posteriors whose parameters are all calibrated, one in twenty has any such
        parameter at most (Bonferroni).
        """
        return tuple(p_value * self.num_tested < LEVEL for p_value in self.p_values)

    def __str__(self) -> str:
        if not self.num_tested:
            return f"not tested, with fewer than {FEWEST} independent observations"
        return "\n".join(in_words(self, default_names(len(self.p_values))))

    __repr__ = __str__  # which notebooks show


def coverage_by_estimate(
    ranks: Tensor,
    estimates: Tensor,
    counts: Counts | None = None,
    *,
    chosen: Tensor | None = None,
    level: float = 0.9,
) -> CoverageByEstimate:
    r"""Test whether the ranks of true parameters depend on the posterior means.

    The ranks :math:`u` and the levels :math:`a^* = |2u - 1|` of central intervals are
    regressed on the ranks of the posterior means, from -1 to 1, and on their squares.
    The first shows a bias that differs from region to region, the second a width that
    is wrong in some. The p-value is that of a permutation test of what both regressions
    explain. It is exact if the posterior is calibrated, and it does not react to errors
    that are the same everywhere, which :func:`acauc_of` measures. The held-out
    posteriors of one set of pairs have errors in common. In simulations of exact ones
    there were no more small p-values for it.

    Ranks and means must come from different samples. Of the same samples, those that
    are too high by chance raise the mean and lower the rank.

    References:
        | Validating Bayesian Inference Algorithms with Simulation-Based Calibration
        | (Talts et al., 2018), on the ranks
        | https://arxiv.org/abs/1804.06788

    Args:
        ranks: The ranks of the true parameters, from 0 to 1, shape ``(n, d)``, such as
            those of :func:`mid_ranks`; NaN where a parameter is not known.
        estimates: The posterior means, shape ``(n, d)``.
        counts: How many pairs each counts as; one each if None.
        chosen: The pairs that are tested, shape ``(n,)``: one of each group, if pairs
            belong to groups. The mean over a group is no posterior mean, and would
            depend on the ranks.
        level: The level of the intervals whose coverage is stated.

    Returns:
        The coverage in each third of the estimates, and the p-values. They are always
        the same for the same input.

    Raises:
        InvalidInputError: If a shape does not fit, a rank is not in [0, 1], or an
            estimate is not finite.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> estimates = torch.linspace(-1, 1, 300)[:, None]
        >>> ranks = torch.rand(300, 1)
        >>> coverage_by_estimate(ranks, estimates).depends
        (False,)
        >>> coverage_by_estimate(ranks ** (1 + estimates / 2), estimates).depends
        (True,)
    """
    check("level", level, Level)
    ranks = read_unit_interval("ranks", ranks)
    estimates = as_batch("estimates", estimates, ranks.shape[1:], rows=len(ranks))
    ranks, estimates = ranks.detach().cpu().double(), estimates.detach().cpu().double()
    known = ~torch.isnan(ranks)
    tested = known if chosen is None else known & chosen.cpu()[:, None]
    p_values = tuple(
        _p_value(ranks[rows, k], estimates[rows, k])
        for k, rows in enumerate(tested.unbind(dim=1))
    )
    edges = torch.stack(
        [_edges(estimates[rows, k]) for k, rows in enumerate(known.unbind(dim=1))]
    )
    # A third of the observations each, even if estimates are equal.
    place = estimates.where(known, torch.inf).argsort(dim=0, stable=True).argsort(dim=0)
    part = place * NUM_PARTS // known.sum(dim=0).clamp_min(1)
    part = part.where(known, NUM_PARTS)
    inside = (2 * ranks - 1).abs() <= level + ROUNDING
    return CoverageByEstimate(
        level=level,
        shares=_in_thirds(inside, part, counts),
        above=_in_thirds(ranks > 0.5, part, counts),
        edges=edges,
        p_values=p_values,
        estimates=estimates,
        ranks=ranks,
    )


def estimates_and_ranks(samples: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return posterior means and ranks, each from one half of the samples.

    Args:
        samples: Posterior samples, shape ``(M, n, d)``.
        theta: True parameters, shape ``(n, d)``.

    Returns:
        Both of shape ``(n, d)``, float64.
    """
    # Not the first half and the second, in case samples are sorted by component.
    return samples[::2].double().mean(dim=0), random_ranks(samples[1::2], theta)


def in_words(
    found: CoverageByEstimate, names: Sequence[str], *, known: str = "parameters"
) -> list[str]:
    """Return a sentence for each parameter whose coverage depends on its estimate.

    If there is none, the sentence says so. There is no sentence if nothing was tested.

    Args:
        found: The outcome.
        names: A name for each parameter.
        known: What the intervals should hold.
    """
    if not found.num_tested:
        return []
    sentences = [
        f"the coverage of {name} depends on its estimate (p = {p_value:.1g}): for the "
        f"lowest, the middle and the highest third of the estimates (below "
        f"{edges[0]:.3g}, above {edges[1]:.3g}), {found.level:.0%} intervals hold "
        f"{_listed(shares)} of the {known}, and {_listed(above)} are above the median "
        "of the posterior"
        for name, p_value, edges, shares, above, depends in zip(
            names,
            found.p_values,
            found.edges.tolist(),
            found.shares.tolist(),
            found.above.tolist(),
            found.depends,
            strict=True,
        )
        if depends
    ]
    least = min(p_value for p_value in found.p_values if not math.isnan(p_value))
    return sentences or [
        "no sign that coverage depends on the estimate (smallest p-value of "
        f"{found.num_tested}: {least:.2g})"
    ]


def _in_thirds(event: Tensor, part: Tensor, counts: Counts | None) -> Tensor:
    """Return the share of pairs in each third that have an event, ``(d, 3)``."""
    shares = [
        means_of_pairs(event.double().where(part == number, torch.nan), counts)
        for number in range(NUM_PARTS)
    ]
    return torch.stack(shares, dim=1)


def _listed(shares: Sequence[float]) -> str:
    *first, last = (f"{share:.0%}" for share in shares)
    return f"{', '.join(first)} and {last}"


def _p_value(ranks: Tensor, estimates: Tensor) -> float:
    if len(ranks) < FEWEST:
        return float("nan")
    place = torch.as_tensor(rankdata(estimates.numpy())) / len(estimates) * 2 - 1
    # Under a calibrated posterior the two outcomes have the same variance: u - 1/2 is
    # uniform on an interval of length one, and so is the level.
    outcomes = torch.stack([ranks, (2 * ranks - 1).abs()], dim=1)
    features = torch.stack([place, place.square()], dim=1)
    with seeded(0):
        return permutation_test(outcomes, features).p_value


def _edges(estimates: Tensor) -> Tensor:
    if not len(estimates):
        return estimates.new_full((NUM_PARTS - 1,), torch.nan)
    steps = torch.arange(1, NUM_PARTS, dtype=estimates.dtype) / NUM_PARTS
    return estimates.quantile(steps)
