"""Scores of a posterior on observations whose true parameters are known."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import torch
from scipy.stats import rankdata
from torch import Tensor

from sbi_rope.data.pairs import (
    effective_number,
    group_means,
    groups_of,
    one_of_each_group,
)
from sbi_rope.metrics.calls import (
    CHUNK_SIZE,
    NumSamples,
    draw_chunks,
    evaluate_log_probs,
    read_test_set,
)
from sbi_rope.metrics.statistics import Estimate, permutation_test
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Positive, check, default_names
from sbi_rope.utils.tensors import as_batch

# The level of the intervals whose coverage is stated.
LEVEL = 0.9
# With fewer observations the interval of the ACAUC reaches over all possible values.
FEWEST = 5
# With fewer observations no dependence on the estimate could be significant.
FEWEST_FOR_DEPENDENCE = 10
# The chance that a calibrated posterior has a parameter that is called dependent.
FALSE_ALARMS = 0.05
NUM_PARTS = 3
NOMINAL = torch.arange(1, 100, dtype=torch.double) / 100
# Levels are ratios of integers. Those that are equal before rounding must be after it.
ROUNDING = 1e-9
ACAUC_IN_WORDS = "0 is calibrated, positive is over-confident, negative is too wide"

Verdict = Literal["over-confident", "too wide", "calibrated", "unknown"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Dependence:
    """The coverage of intervals where estimates are low, middling and high.

    Attributes:
        p_values: The p-value of each parameter; NaN with fewer than ten observations.
        shares: The share of true parameters inside their 90 % intervals, for the
            lowest, the middle and the highest third of the estimates, shape ``(d, 3)``.
        above: The share of true parameters above the posterior's median in each third,
            shape ``(d, 3)``; about one half if the posterior is calibrated.
        edges: The estimates that divide the thirds, shape ``(d, 2)``.
    """

    p_values: tuple[float, ...]
    shares: Tensor = field(repr=False)
    above: Tensor = field(repr=False)
    edges: Tensor = field(repr=False)

    @property
    def num_tested(self) -> int:
        """The number of parameters with a p-value."""
        return sum(not math.isnan(p_value) for p_value in self.p_values)

    @property
    def found(self) -> tuple[bool, ...]:
        """Whether the coverage of each parameter depends on its estimate.

        At most one calibrated posterior in twenty has such a parameter (Bonferroni).
        """
        return tuple(p * self.num_tested < FALSE_ALARMS for p in self.p_values)


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    r"""The scores of a posterior on a test set, or of a stack on its hold-out pairs.

    Print it for a summary. All scores are means over the n observations, with intervals
    of Student's t.

    Attributes:
        log_prob: The log density of the true parameters, :math:`-\infty` where the
            posterior excludes them, shape ``(n,)``.
        ranks: The rank of each true parameter among samples of the posterior, from 0 to
            1, shape ``(n, d)``; NaN where a parameter is not known. Ranks are uniform
            if the posterior is calibrated.
        estimates: The posterior means, shape ``(n, d)``. They are of other samples than
            the ranks, because samples that are too high by chance would raise the mean
            and lower the rank.
        log_unit: The log of the unit of theta in :attr:`lpp_z`, summed over parameters,
            a number or one for each observation; NaN if it is unknown.
        weight: The weight of each observation, shape ``(n,)``; one each if None.
        group: A number for each observation, shape ``(n,)``. Observations of one group,
            such as a person, are not independent. None if all are.
        parameter_names: One name for each parameter; None if they have none.
    """

    log_prob: Tensor = field(repr=False)
    ranks: Tensor = field(repr=False)
    estimates: Tensor = field(repr=False)
    log_unit: float | Tensor = math.nan
    weight: Tensor | None = field(default=None, repr=False)
    group: Tensor | None = field(default=None, repr=False)
    parameter_names: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.log_prob)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters; "theta_1" and so on if they have none."""
        return self.parameter_names or default_names(self.ranks.shape[1])

    @property
    def num_independent(self) -> float:
        """The number of independent observations of equal weight that tell as much."""
        return self._number(torch.ones_like(self.log_prob, dtype=torch.bool))

    def _number(self, rows: Tensor) -> float:
        weight = torch.ones(len(self)) if self.weight is None else self.weight.cpu()
        weight = weight[rows := rows.cpu()]
        if self.group is not None:
            weight = group_means(weight, weight, self.group.cpu()[rows])[1]
        return effective_number(weight) if len(weight) else 0.0

    def mean(self, values: Tensor, *, confidence: float = 0.95) -> Estimate:
        """Return the mean over observations of one number each, shape ``(n,)``."""
        return Estimate.of(values, self.weight, self.group, confidence=confidence)

    @property
    def lpp(self) -> Estimate:
        r"""The mean log density of the true parameters, in nats; higher is better.

        .. math:: \text{LPP} = \frac{1}{n} \sum_i \log \tilde p(\theta_i \mid x_i)

        References:
            | Addressing Misspecification in Simulation-based Inference through
            | Data-driven Calibration (Wehenkel et al., 2025), section 4, Metrics
            | https://arxiv.org/abs/2405.08719
        """
        return self.mean(self.log_prob)

    @property
    def lpp_z(self) -> Estimate:
        r"""The LPP with theta in other units, those of the prior unless given.

        The density of :math:`z_j = \theta_j / s_j` is
        :math:`p(z \mid x) = p(\theta \mid x) \prod_j s_j`.
        """
        return self.mean(self.log_prob + self.log_unit)

    @property
    def levels(self) -> Tensor:
        r"""The level of the smallest central interval that holds each true parameter.

        .. math:: a^* = |2 u - 1|

        Here u is the rank. The shape is ``(n, d)``.
        """
        return (2 * self.ranks.double() - 1).abs()

    @property
    def acauc(self) -> Estimate:
        r"""The average coverage AUC, 0 if calibrated and positive if over-confident.

        .. math:: \text{ACAUC} = \frac{1}{d n} \sum_{j, i} \int_0^1 \alpha
            - \mathbf{1}[\theta_{ij} \in \Theta_{ij}(\alpha)] \,\mathrm{d}\alpha
            = \frac{1}{d n} \sum_{j, i} a^*_{ij} - \frac{1}{2}

        The interval is wider than that of other means by :math:`\sqrt{n / (n - 1)}`.
        Without this factor, it would be too narrow for a few uniform levels. With it,
        the interval leaves 0 out for 4 to 5 % of calibrated posteriors, with 10 to 50
        observations and one to five parameters.

        References:
            | Addressing Misspecification in Simulation-based Inference through
            | Data-driven Calibration (Wehenkel et al., 2025), section 4, Metrics
            | https://arxiv.org/abs/2405.08719
        """
        return self._acauc(self.levels.nanmean(dim=1), 0.95)

    @property
    def acauc_of_parameters(self) -> tuple[Estimate, ...]:
        """The ACAUC of each parameter alone.

        The intervals of d calibrated parameters all hold 0 in at least 95 % of the
        cases (Bonferroni).
        """
        columns = self.levels.unbind(dim=1)
        return tuple(self._acauc(one, 1 - 0.05 / len(columns)) for one in columns)

    def _acauc(self, levels: Tensor, confidence: float) -> Estimate:
        found, n = (
            self.mean(levels, confidence=confidence),
            self._number(~levels.isnan()),
        )
        half = (found.high - found.mean) * (n / max(1.0, n - 1)) ** 0.5
        mean = found.mean - 0.5
        return Estimate(mean, mean - half, mean + half)

    @property
    def coverage(self) -> Tensor:
        """The share of true parameters in the central intervals of levels .01 to .99.

        Of each parameter, shape ``(99, d)``. It is exact to about one over the number
        of samples behind the ranks.
        """
        return torch.stack([self._inside(float(level)) for level in NOMINAL])

    def inside(self, level: float) -> float:
        """Return the share of true parameters in central intervals of a level."""
        return float(self._inside(level).nanmean())

    def _inside(self, level: float) -> Tensor:
        return _means(self._event(self.levels <= level + ROUNDING), self.weight)

    def _event(self, happened: Tensor) -> Tensor:
        return happened.double().where(~self.ranks.isnan(), torch.nan)

    @property
    def expected_coverage_error(self) -> float:
        r"""The mean distance of the coverage from the level, over all parameters.

        Over-confidence in one parameter cannot cancel under-confidence in another. A
        calibrated posterior has about :math:`0.31 / \sqrt{n}`.
        """
        gap = self.coverage - NOMINAL[:, None].to(self.ranks.device)
        return float(gap.abs().nanmean())

    @cached_property
    def dependence(self) -> Dependence:
        r"""Whether coverage depends on the estimate, by a permutation test.

        Coverage that is right on average can be wrong for small and for large
        parameters. The ranks u and the levels :math:`|2u - 1|` are regressed on the
        ranks of the posterior means and on their squares. The ranks u show a bias that
        differs from region to region, the levels a wrong width in some. The test is
        exact if the posterior is calibrated, and does not react to errors that are the
        same everywhere, which :attr:`acauc` measures. One observation of each group is
        tested.

        References:
            | Validating Bayesian Inference Algorithms with Simulation-Based Calibration
            | (Talts et al., 2018), on the ranks
            | https://arxiv.org/abs/1804.06788
        """
        ranks, estimates = self.ranks.cpu().double(), self.estimates.cpu().double()
        known = ~torch.isnan(ranks)
        tested = known
        if self.group is not None:
            chosen = one_of_each_group(groups_of(self.group), seed=0)
            tested = known & chosen.cpu()[:, None]
        columns = range(ranks.shape[1])
        # A third of the observations each, even if estimates are equal.
        place = estimates.where(known, torch.inf).argsort(dim=0, stable=True)
        part = place.argsort(dim=0) * NUM_PARTS // known.sum(dim=0).clamp_min(1)
        weight = None if self.weight is None else self.weight.cpu()

        def in_thirds(happened: Tensor) -> Tensor:
            event = self._event(happened).cpu()
            each = [event.where(part == t, torch.nan) for t in range(NUM_PARTS)]
            return torch.stack([_means(one, weight) for one in each], dim=1)

        return Dependence(
            p_values=tuple(
                _p_value(ranks[tested[:, k], k], estimates[tested[:, k], k])
                for k in columns
            ),
            shares=in_thirds(self.levels <= LEVEL + ROUNDING),
            above=in_thirds(self.ranks > 0.5),
            edges=torch.stack([_edges(estimates[known[:, k], k]) for k in columns]),
        )

    def as_row(self) -> dict[str, float]:
        """Return the main scores as the row of a table; an unknown one is NaN."""
        return {
            "lpp": self.lpp.mean,
            "lpp_z": self.lpp_z.mean,
            "acauc": self.acauc.mean,
            "expected_coverage_error": self.expected_coverage_error,
        }

    def lines(
        self, *, known: str = "true parameters", names: Sequence[str] | None = None
    ) -> list[tuple[str, bool]]:
        """Return sentences about the calibration, and whether each is alarming.

        Args:
            known: What the intervals should hold.
            names: A name for each parameter; :attr:`names` if None.
        """
        n, names = self.num_independent, names or self.names
        verdict = verdict_of(self.acauc)
        if verdict == "unknown":
            return [("Whether it is calibrated is not known.", False)]
        acauc = f"ACAUC {self.acauc:+.3f}; {ACAUC_IN_WORDS}"
        if n < FEWEST:
            return [(f"Too few observations to check calibration: {acauc}.", False)]
        off = [
            (f"{name} alone is {verdict_of(one)}: ACAUC {one:+.3f}.", True)
            for name, one in zip(names, self.acauc_of_parameters, strict=True)
            if verdict_of(one) in ("over-confident", "too wide") and len(names) > 1
        ]
        if verdict == "calibrated":
            average = ", on average over parameters," if off else ""
            what = "observations" if self.group is None else "groups"
            start = f"Calibrated{average} as far as {n:.0f} {what} can tell"
        else:
            start = f"The posterior is {verdict}"
        return [
            (f"{start}: {acauc}.", verdict != "calibrated"),
            *off,
            *(
                (f"{name} was not measured, so its width is not checked.", False)
                for name, column in zip(names, self.ranks.unbind(1), strict=True)
                if column.isnan().all()
            ),
            (
                f"50% intervals hold {self.inside(0.5):.0%} of the {known}, "
                f"{LEVEL:.0%} intervals {self.inside(LEVEL):.0%}.",
                False,
            ),
            *self._lines_on_dependence(known, names),
        ]

    def _lines_on_dependence(
        self, known: str, names: Sequence[str]
    ) -> list[tuple[str, bool]]:
        found = self.dependence
        if not found.num_tested:
            return []
        lines = [
            (
                f"The coverage of {name} depends on its estimate (p = {p_value:.1g}). "
                f"Where estimates are low (below {edges[0]:.3g}), middling and high "
                f"(above {edges[1]:.3g}), {LEVEL:.0%} intervals hold {_listed(shares)} "
                f"of the {known}, and {_listed(above)} are above the median.",
                True,
            )
            for name, p_value, edges, shares, above, depends in zip(
                names,
                found.p_values,
                found.edges.tolist(),
                found.shares.tolist(),
                found.above.tolist(),
                found.found,
                strict=True,
            )
            if depends
        ]
        least = min(p for p in found.p_values if not math.isnan(p))
        none = (
            f"No sign that coverage depends on the estimate (smallest p-value of "
            f"{found.num_tested}: {least:.2g}).",
            False,
        )
        return lines or [none]

    def __str__(self) -> str:
        n, d = self.ranks.shape
        lines = [
            f"Scores on {n} observation{'s' * (n > 1)} of {d} "
            f"parameter{'s' * (d > 1)}, with 95% intervals",
            f"  LPP, the log density of the true parameters: {self.lpp:.2f} nats",
        ]
        if not math.isnan(self.lpp_z.mean):
            lines.append(
                f"  LPP with theta in prior standard deviations: {self.lpp_z:.2f}"
            )
        if excluded := float(torch.isneginf(self.log_prob).double().mean()):
            lines.append(
                f"  {excluded:.1%} of the true parameters have density zero: they are "
                "outside the prior, or in another unit."
            )
        lines += [
            textwrap.fill(text, 80, initial_indent="  ", subsequent_indent="    ")
            for text, _ in self.lines()
        ]
        return "\n".join(lines)

    __repr__ = __str__  # which notebooks show


def verdict_of(acauc: Estimate) -> Verdict:
    """Return what an ACAUC says; "unknown" where nothing was scored.

    It is "calibrated" unless the interval leaves 0 out.
    """
    if math.isnan(acauc.low):
        return "unknown"
    if acauc.low > 0:
        return "over-confident"
    return "too wide" if acauc.high < 0 else "calibrated"


def evaluate(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    theta_std: Tensor | None = None,
    num_samples: int = 1000,
    seed: int | None = None,
    chunk_size: int = CHUNK_SIZE,
    show_progress_bars: bool = False,
) -> Evaluation:
    r"""Score a posterior by the density of the true parameters and by calibration.

    sbi's own posteriors are scored without rejecting samples outside the prior, and
    without correcting the density for the rejection: both may never end on real data.
    Mass outside the prior counts as an error.

    Args:
        posterior: Any posterior with ``sample_batched`` and ``log_prob_batched``.
        theta: True parameters, shape ``(n, d)``. Noise of measurements makes a good
            posterior look over-confident.
        x: Their observations, shape ``(n, *event_shape)``.
        theta_std: The unit of each parameter for ``lpp_z``, shape ``(d,)``. If None,
            the standard deviations of the posterior's prior.
        num_samples: The number of posterior samples for each observation, 20 or more.
            A fifth of them is for the estimates, the others are for the ranks.
        seed: The seed of the samples, which also depend on ``chunk_size``.
        chunk_size: How many observations are scored at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The scores.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If the posterior has no ``log_prob_batched``.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.density import PriorPosterior
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> found = evaluate(PriorPosterior(prior), torch.rand(9, 1), torch.rand(9, 2))
        >>> found.lpp.mean
        0.0
    """
    theta, x = read_test_set(posterior, theta, x, chunk_size)
    check("num_samples", num_samples, NumSamples)
    with seeded(seed):
        log_prob = evaluate_log_probs(
            posterior, theta, x, chunk_size=chunk_size, show=show_progress_bars
        )
        chunks = draw_chunks(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
        found = [estimates_and_ranks(draws, theta[rows]) for rows, draws in chunks]
    estimates, ranks = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Evaluation(
        log_prob=log_prob,
        ranks=ranks,
        estimates=estimates,
        log_unit=_log_unit(posterior, theta_std, theta),
        parameter_names=getattr(posterior, "parameter_names", None),
    )


def estimates_and_ranks(samples: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return posterior means of every fifth sample, and ranks among the others.

    The rank among M samples is

    .. math:: u = \frac{1}{M + 1} \Big( \#\{m: \theta^m < \theta\}
        + v \, \big(1 + \#\{m: \theta^m = \theta\}\big) \Big)

    with v one half, or uniform where samples are equal to theta, so that the ranks of
    discrete parameters are uniform, too, if the posterior is calibrated.

    Args:
        samples: Posterior samples, shape ``(num_samples, n, d)``.
        theta: True parameters, shape ``(n, d)``.

    Returns:
        Both of shape ``(n, d)``, float64.
    """
    # Not the first fifth, in case samples are sorted by component.
    is_mean = torch.arange(len(samples), device=samples.device) % 5 == 0
    others = samples[~is_mean]
    below = (others < theta).sum(dim=0).double()
    equal = (others == theta).sum(dim=0).double()
    share = torch.full_like(below, 0.5)
    if equal.any():
        share[equal > 0] = torch.rand(int((equal > 0).sum())).to(share)
    ranks = (below + share * (1 + equal)) / (len(others) + 1)
    return samples[is_mean].double().mean(dim=0), ranks


def _log_unit(posterior: Any, theta_std: Tensor | None, theta: Tensor) -> float:
    """Return the log of the units of theta, those of the prior if none are given."""
    if theta_std is None:
        try:
            theta_std = PriorDistribution(posterior.prior).stddev
        except Exception:  # posteriors of users need not have a prior
            return math.nan
    units = as_batch("theta_std", theta_std, (), rows=theta.shape[1])
    check("theta_std", float(units.min()), Positive)
    return float(units.double().log().sum())


def _means(values: Tensor, weight: Tensor | None) -> Tensor:
    """Return the weighted mean of columns ``(n, d)`` without their NaN, ``(d,)``."""
    if weight is None:
        return values.nanmean(dim=0)
    weights = weight.to(values)[:, None] * ~torch.isnan(values)
    return (weights * values.nan_to_num()).sum(dim=0) / weights.sum(dim=0)


def _p_value(ranks: Tensor, estimates: Tensor) -> float:
    if len(ranks) < FEWEST_FOR_DEPENDENCE:
        return math.nan
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


def _listed(shares: Sequence[float]) -> str:
    *first, last = (f"{share:.0%}" for share in shares)
    return f"{', '.join(first)} and {last}"
