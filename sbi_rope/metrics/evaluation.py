"""Scores of a posterior on observations whose true parameters are known."""

import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from scipy.stats import rankdata
from torch import Tensor

from sbi_rope.data.pairs import (
    effective_number,
    group_means,
    groups_of,
    one_of_each_group,
)
from sbi_rope.metrics.calls import log_probs_of, read_theta, read_x, samples_of
from sbi_rope.metrics.statistics import Estimate
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.progress import progress_bar
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Positive, Range, check, default_names
from sbi_rope.utils.tensors import as_batch, rows_with

# The level of the intervals whose coverage is stated.
LEVEL = 0.9
# With fewer observations the interval of the ACAUC reaches over all possible values.
FEWEST = 5
# With fewer observations no dependence on the estimate could be significant.
FEWEST_FOR_DEPENDENCE = 10
NUM_PERMUTATIONS = 1000
# The chance that a calibrated posterior has a parameter that is called dependent.
FALSE_ALARMS = 0.05
NOMINAL = torch.arange(1, 100, dtype=torch.double) / 100
# Levels are ratios of integers. Those that are equal before rounding must be after it.
ROUNDING = 1e-9
# How many observations a posterior is called with at a time.
CHUNK_SIZE = 100
# By a single draw all posteriors look calibrated whose draws are too large as often as
# too small.
NumSamples = Annotated[int, Range(20)]


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
        return self._number(torch.ones(len(self)))

    def _number(self, is_known: Tensor) -> float:
        weight = self._weight * is_known.cpu()
        if self.group is not None:
            weight = group_means(weight, weight, self.group.cpu())[1]
        return effective_number(weight)

    @property
    def _weight(self) -> Tensor:
        weight = torch.ones(len(self)) if self.weight is None else self.weight
        return weight.double().cpu()

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

        It is :math:`a^* = |2 u - 1|`, with the rank u. The shape is ``(n, d)``.
        """
        return (2 * self.ranks.double() - 1).abs()

    @property
    def acauc(self) -> Estimate:
        r"""The average coverage AUC, 0 if calibrated and positive if over-confident.

        .. math:: \text{ACAUC} = \frac{1}{d n} \sum_{j, i} \int_0^1 \alpha
            - \mathbf{1}[\theta_{ij} \in \Theta_{ij}(\alpha)] \,\mathrm{d}\alpha
            = \frac{1}{d n} \sum_{j, i} a^*_{ij} - \frac{1}{2}

        The interval is wider than that of other means by :math:`\sqrt{n / (n - 1)}`, so
        that it leaves 0 out for 4 to 5 % of calibrated posteriors, with 10 to 50
        observations and one to five parameters. The paper is that of :attr:`lpp`.
        """
        return self._acauc(self.levels.nanmean(dim=1), 0.95)

    @property
    def acauc_of_parameters(self) -> tuple[Estimate, ...]:
        """The ACAUC of each parameter alone.

        The intervals of d calibrated parameters all hold 0 in about 95 % of the cases
        (Bonferroni).
        """
        columns = self.levels.unbind(dim=1)
        return tuple(self._acauc(one, 1 - 0.05 / len(columns)) for one in columns)

    def _acauc(self, levels: Tensor, confidence: float) -> Estimate:
        found = self.mean(levels, confidence=confidence)
        mean, n = found.mean - 0.5, self._number(~levels.isnan())
        half = (found.high - found.mean) * (n / max(1.0, n - 1)) ** 0.5
        return Estimate(mean, mean - half, mean + half)

    @property
    def coverage(self) -> Tensor:
        """The share of true parameters in the central intervals of levels .01 to .99.

        Of each parameter, shape ``(99, d)``; NaN if it is not known anywhere. It is
        exact to about one over the number of samples behind the ranks.
        """
        levels = self.levels
        weights = self._weight.to(levels)[:, None] * ~levels.isnan()
        shares = [
            (weights * (levels <= level + ROUNDING)).sum(dim=0)
            for level in NOMINAL.tolist()
        ]
        return torch.stack(shares) / weights.sum(dim=0)

    @property
    def dependence(self) -> tuple[float, ...]:
        r"""P-values of a test whether the coverage of a parameter depends on its value.

        Coverage that is right on average can be wrong for small and for large
        parameters. The ranks u and the levels :math:`|2u - 1|` are regressed on the
        ranks of the posterior means and on their squares: u shows a bias, and the level
        a wrong width, that differ from region to region. The permutation test is exact
        if the posterior is calibrated. One observation of each group is tested. The
        p-value of a parameter is NaN with fewer than ten observations.

        References:
            | Validating Bayesian Inference Algorithms with Simulation-Based Calibration
            | (Talts et al., 2018), on the ranks
            | https://arxiv.org/abs/1804.06788
        """
        tested = ~self.ranks.cpu().isnan()
        if self.group is not None:
            tested &= one_of_each_group(groups_of(self.group), seed=0).cpu()[:, None]
        ranks, means = self.ranks.cpu().double(), self.estimates.cpu().double()
        columns = zip(ranks.T, means.T, tested.T, strict=True)
        return tuple(_p_value(u[rows], mean[rows]) for u, mean, rows in columns)

    def lines(self, *, known: str = "true parameters") -> list[tuple[str, bool]]:
        """Return sentences about the calibration, and whether each is alarming."""
        n, acauc = self.num_independent, self.acauc
        if n < FEWEST or math.isnan(acauc.low):
            return [("Too few known parameters to check calibration.", False)]
        verdict, off, unknown = _verdict(acauc), [], []
        for name, one in zip(self.names, self.acauc_of_parameters, strict=True):
            alone = _verdict(one)
            if math.isnan(one.mean):
                text = f"{name} was not measured, so its width is not checked."
                unknown.append((text, False))
            elif alone != "calibrated" and len(self.names) > 1:
                off.append((f"{name} alone is {alone}: ACAUC {one:+.3f}.", True))
        start = f"The posterior is {verdict}"
        if verdict == "calibrated":
            average = ", on average over parameters," if off else ""
            what = "observations" if self.group is None else "groups"
            start = f"Calibrated{average} as far as {n:.0f} {what} can tell"
        start += f": ACAUC {acauc:+.3f}; 0 is calibrated, positive is over-confident, "
        first = f"{start}negative is too wide.", verdict != "calibrated"
        half, most = self.coverage[[49, 89]].nanmean(dim=1).tolist()
        shares = f"50% intervals hold {half:.0%} of the {known}, "
        shares += f"{LEVEL:.0%} intervals {most:.0%}."
        return [first, *off, *unknown, (shares, False), *self._dependence_lines(known)]

    def _dependence_lines(self, known: str) -> list[tuple[str, bool]]:
        p_values, lines = self.dependence, []
        tested = [p for p in p_values if not math.isnan(p)]
        for k, p_value in enumerate(p_values):
            if p_value * len(tested) < FALSE_ALARMS:  # Bonferroni
                inside, above = self._in_thirds(k)
                text = (
                    f"The coverage of {self.names[k]} depends on its estimate (p = "
                    f"{p_value:.1g}). In the lowest, middle and highest third of the "
                    f"estimates, {LEVEL:.0%} intervals hold {inside} of the {known}, "
                    f"and {above} are above the median."
                )
                lines.append((text, True))
        if tested and not lines:
            text = "No sign that coverage depends on the estimate (smallest p-value of "
            lines.append((f"{text}{len(tested)}: {min(tested):.2g}).", False))
        return lines

    def _in_thirds(self, column: int) -> list[str]:
        ranks, estimates = self.ranks[:, column].cpu(), self.estimates[:, column].cpu()
        rows = (~ranks.isnan()).nonzero().flatten()
        thirds = rows[estimates[rows].argsort(stable=True)].tensor_split(3)
        weight, levels = self._weight, self.levels[:, column].cpu()
        texts = []
        for event in (levels <= LEVEL + ROUNDING, ranks > 0.5):
            shares = ((weight * event)[i].sum() / weight[i].sum() for i in thirds)
            texts.append("{:.0%}, {:.0%} and {:.0%}".format(*shares))
        return texts

    def __str__(self) -> str:
        n, d = self.ranks.shape
        lines = [
            f"Scores on {n} observation{'s' * (n > 1)} of {d} "
            f"parameter{'s' * (d > 1)}, with 95% intervals",
            f"  LPP, the log density of the true parameters: {self.lpp:.2f} nats",
        ]
        if not math.isnan(self.lpp_z.mean):
            text = f"  LPP with theta in prior standard deviations: {self.lpp_z:.2f}"
            lines.append(text)
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


def _verdict(acauc: Estimate) -> str:
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
        seed: The seed of the samples.
        show_progress_bars: Whether to show progress.

    Returns:
        The scores.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.density import PriorPosterior
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> found = evaluate(PriorPosterior(prior), torch.rand(9, 1), torch.rand(9, 2))
        >>> found.lpp.mean
        0.0
    """
    check("num_samples", num_samples, NumSamples)
    theta = read_theta(posterior, theta)
    x = read_x(posterior, x, rows=len(theta))
    chunks = [*zip(theta.split(CHUNK_SIZE), x.split(CHUNK_SIZE), strict=True)]

    def bar(text: str) -> Iterable[tuple[Tensor, Tensor]]:
        return progress_bar(chunks, show=show_progress_bars, desc=text)

    with seeded(seed):
        log_prob = torch.cat(
            [log_probs_of(posterior, *chunk) for chunk in bar("Evaluating log_prob")]
        )
        bad = torch.isnan(log_prob) | torch.isposinf(log_prob)
        if bad.any():
            raise InvalidInputError(
                "Expected a posterior with finite results; got log-probabilities that "
                f"are NaN or +Inf in {rows_with(bad)}."
            )
        found = [
            estimates_and_ranks(
                samples_of(posterior, some_x, num_samples, theta.shape[1]), some
            )
            for some, some_x in bar("Drawing samples")
        ]
    estimates, ranks = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Evaluation(
        log_prob=log_prob,
        ranks=ranks,
        estimates=estimates,
        log_unit=_log_unit(posterior, theta_std, theta.shape[1]),
        parameter_names=getattr(posterior, "parameter_names", None),
    )


def estimates_and_ranks(samples: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return posterior means of every fifth sample, and ranks among the others.

    The rank among M samples is

    .. math:: u = \frac{1}{M + 1} \Big( \#\{m: \theta^m < \theta\}
        + v \, \big(1 + \#\{m: \theta^m = \theta\}\big) \Big)

    with v one half, or uniform where samples are equal to theta, so that the ranks of
    discrete parameters are uniform, too, if the posterior is calibrated. Samples
    ``(num_samples, n, d)`` and theta ``(n, d)`` give two float64 tensors ``(n, d)``.
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


def _log_unit(posterior: Any, theta_std: Tensor | None, dim: int) -> float:
    """Return the log of the units of theta, those of the prior if none are given."""
    if theta_std is None:
        try:
            return float(PriorDistribution(posterior.prior).log_units().sum())
        except Exception:  # posteriors of users need not have a prior
            return math.nan
    units = as_batch("theta_std", theta_std, (), rows=dim)
    check("theta_std", float(units.min()), Positive)
    return float(units.double().log().sum())


def _p_value(ranks: Tensor, estimates: Tensor) -> float:
    """Return how often permuted ranks depend on the estimates as much as these."""
    if len(ranks) < FEWEST_FOR_DEPENDENCE:
        return math.nan
    place = torch.as_tensor(rankdata(estimates.numpy())) / len(estimates) * 2 - 1
    features = torch.stack([place, place.square()], dim=1)
    features -= features.mean(dim=0)
    basis, values, _ = torch.linalg.svd(features, full_matrices=False)
    basis = basis[:, values > 1e-9 * values.max()]
    # Under a calibrated posterior the two outcomes have the same variance: u - 1/2 is
    # uniform on an interval of length one, and so is the level.
    outcomes = torch.stack([ranks, (2 * ranks - 1).abs()], dim=1)
    outcomes = outcomes - outcomes.mean(dim=0)
    with seeded(0):
        orders = [torch.randperm(len(ranks)) for _ in range(NUM_PERMUTATIONS)]
    # The sum of squares that the regression explains.
    explained = (basis.T @ outcomes).square().sum()
    permuted = [
        (basis.T @ outcomes[rows]).square().sum(dim=(1, 2))
        for rows in torch.stack(orders).split(100)  # to save memory
    ]
    # A permutation that is equal up to rounding counts, and so do the ranks themselves.
    reached = int((torch.cat(permuted) >= explained * (1 - 1e-12)).sum())
    return (1 + reached) / (1 + NUM_PERMUTATIONS)
