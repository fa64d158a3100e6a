r"""Scores of calibration as functions of ranks and credible levels.

For nested credible regions, let :math:`a^*` be the level of the smallest region that
contains the true parameter. For a calibrated posterior :math:`a^*` is uniform on
[0, 1]. For an over-confident one it is too large. Every score here is a mean of a
function of :math:`a^*`.
"""

import math
from dataclasses import dataclass, field

import torch
from scipy.stats import t as student
from torch import Tensor

from sbi_rope._statistics import (
    mean_and_error,
    mean_of_known,
    means_of_pairs,
    standard_error_of_mean,
)
from sbi_rope.data import Counts
from sbi_rope.errors import InvalidInputError
from sbi_rope.tensors import as_batch, as_numbers

__all__ = [
    "ACAUC_IN_WORDS",
    "ACAUCScore",
    "CoverageCurve",
    "CoverageErrorScore",
    "acauc_of",
    "central_levels",
    "count_ranks",
    "coverage_curve_of",
    "expected_coverage_error_of",
    "mid_ranks",
    "random_ranks",
    "read_unit_interval",
]

# Levels and ranks are ratios of integers. Those that are equal before rounding must
# still count as equal after it.
ROUNDING = 1e-9
# How far a level may be above 1. One that was calculated in float32 can be.
ROUNDING_OF_LEVELS = 1e-6
# With fewer observations the interval of ACAUC is as wide as all that it can be.
FEWEST = 5
# How printed scores explain ACAUC.
ACAUC_IN_WORDS = "0 is calibrated, positive is over-confident, negative is too wide"


@dataclass(frozen=True, eq=False, kw_only=True)
class ACAUCScore:
    """Average coverage AUC. It is zero if calibrated and positive if over-confident.

    Attributes:
        value: The mean over parameters and observations, in [-1/2, 1/2].
        standard_error: The standard error of ``value`` over observations. It does not
            take the parameters of one observation for independent. NaN for a single
            observation.
        interval: The 95 % interval of ``value``, see :func:`acauc_of`. NaN for a single
            observation.
        per_parameter: The mean over observations, shape ``(d,)``, or ``(1,)`` for joint
            regions.
    """

    value: float
    standard_error: float
    interval: tuple[float, float]
    per_parameter: Tensor = field(repr=False)

    @property
    def verdict(self) -> str:
        """One of "over-confident", "too wide", "calibrated" and "unknown".

        It is "calibrated" unless the interval leaves 0 out, and means that the
        observations show nothing else. It is "unknown" where nothing was scored.
        """
        low, high = self.interval
        if math.isnan(low):
            return "unknown"
        if low > 0:
            return "over-confident"
        return "too wide" if high < 0 else "calibrated"


@dataclass(frozen=True, eq=False, kw_only=True)
class CoverageCurve:
    """Share of true parameters inside the central credible interval of each level.

    Attributes:
        levels: The nominal levels .01, .02, ..., .99, shape ``(99,)``.
        per_parameter: The coverage of each parameter, shape ``(d, 99)``.
        standard_error: The standard error of ``average`` over observations, shape
            ``(99,)``.
        num_observations: The size of the test set. If some parameters are not known
            everywhere, the number of complete observations that tell as much about a
            curve, on average over parameters.
    """

    levels: Tensor = field(repr=False)
    per_parameter: Tensor = field(repr=False)
    standard_error: Tensor = field(repr=False)
    num_observations: int

    @property
    def average(self) -> Tensor:
        """The coverage averaged over parameters that are known, shape ``(99,)``."""
        return mean_of_known(self.per_parameter, dim=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class CoverageErrorScore:
    """Mean absolute distance of the coverage curves from the diagonal.

    Attributes:
        value: The mean over parameters and levels, in [0, 1/2].
        standard_error: The standard error of ``value`` over observations, to first
            order.
        per_parameter: The mean over levels, shape ``(d,)``.
        if_calibrated: What a calibrated posterior scores on average. NaN in files of
            earlier versions, and if nothing is known.
    """

    value: float
    standard_error: float
    per_parameter: Tensor = field(repr=False)
    if_calibrated: float = math.nan


def mid_ranks(samples: Tensor, theta: Tensor) -> Tensor:
    r"""Estimate the posterior's distribution function at the true parameter.

    .. math:: u_{ij} = \frac{1}{M + 1} \Big( \tfrac{1}{2}
        + \#\{m: \theta^m_{ij} < \theta_{ij}\}
        + \tfrac{1}{2} \#\{m: \theta^m_{ij} = \theta_{ij}\} \Big)

    A sample that is equal to the true parameter counts half as below it. Scores of this
    package draw at random how many of them count, so that they are right for discrete
    parameters, too.

    Args:
        samples: Posterior samples, shape ``(M, n, d)``.
        theta: True parameters, shape ``(n, d)``.

    Returns:
        The ranks, strictly between 0 and 1, float64, shape ``(n, d)``.

    Raises:
        InvalidInputError: If a shape does not fit, there is no sample, or an entry is
            NaN, which cannot be ranked. Infinite entries can be.

    Example:
        >>> mid_ranks(torch.tensor([[[0.0]], [[1.0]], [[1.0]]]), torch.tensor([[1.0]]))
        tensor([[0.6250]], dtype=torch.float64)
    """
    theta = as_numbers("theta", theta)
    theta = as_batch("theta", theta, theta.shape[-1:], finite=False)
    samples = as_batch("samples", samples, theta.shape, finite=False)
    if torch.isnan(samples).any() or torch.isnan(theta).any():
        raise InvalidInputError("Expected `samples` and `theta` without NaN.")
    return count_ranks(samples, theta)


def count_ranks(samples: Tensor, theta: Tensor) -> Tensor:
    """Return :func:`mid_ranks` without checking the arguments."""
    below = (samples < theta).sum(dim=0).double()
    equal = (samples == theta).sum(dim=0).double()
    return (below + equal / 2 + 0.5) / (samples.shape[0] + 1)


def random_ranks(samples: Tensor, theta: Tensor) -> Tensor:
    r"""Return ranks in which samples that are equal to the true parameter are random.

    A discrete parameter is often equal to samples. Its mid-rank is near 1/2 then, as if
    the posterior were too wide. If a uniform share of the equal samples counts as
    below, ranks of a calibrated posterior are uniform. The shares come from torch's
    random state, which is left alone if nothing is equal.

    Args:
        samples: Posterior samples, shape ``(M, n, d)``.
        theta: True parameters, shape ``(n, d)``.
    """
    equal = (samples == theta).sum(dim=0).double()
    ranks = count_ranks(samples, theta)
    if not equal.any():
        return ranks
    shares = torch.rand(equal.shape, dtype=torch.double).to(ranks) - 0.5
    moved = ranks + shares * (equal + 1) / (samples.shape[0] + 1)
    return torch.where(equal > 0, moved, ranks)


def central_levels(ranks: Tensor) -> Tensor:
    r"""Return the level of the smallest central interval that contains theta.

    .. math:: a^* = |2u - 1|

    Args:
        ranks: The ranks :math:`u` of the true parameters, in any shape.

    Returns:
        The levels, in the same shape.

    Raises:
        InvalidInputError: If a rank is not in [0, 1].
    """
    return (2.0 * _in_unit_interval("ranks", as_numbers("ranks", ranks)) - 1.0).abs()


def acauc_of(
    levels: Tensor, counts: Counts | None = None, *, confidence: float = 0.95
) -> ACAUCScore:
    r"""Average the coverage error over all levels, parameters and observations.

    .. math:: \text{ACAUC} = \frac{1}{d n} \sum_{j=1}^{d} \sum_{i=1}^{n} \int_0^1
        \alpha - \mathbf{1}[\theta_{ij} \in \Theta_{ij}(\alpha)] \,\mathrm{d}\alpha
        = \frac{1}{d n} \sum_{j, i} a^*_{ij} - \frac{1}{2}.

    The two are equal because the regions :math:`\Theta(\alpha)` are nested: they
    contain theta at all levels from :math:`a^*` on.

    The interval is :math:`\text{ACAUC} \pm t_{n-1}\, s / \sqrt{n - 1}`, with s the
    standard deviation over observations and :math:`t_{n-1}` the 97.5 % quantile of
    Student's distribution. With :math:`s / \sqrt n` it would be too narrow for a few
    uniform levels. In simulations of calibrated posteriors, with 10 to 50 observations,
    and with one to five parameters that are independent or not, it leaves 0 out in 4 to
    5 % of the cases. The parameters of one observation need not be independent, but the
    observations must be.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Metrics
        | https://arxiv.org/abs/2405.08719

    Args:
        levels: The levels :math:`a^*` of the true parameters, shape ``(n, d)``; NaN
            where a parameter is not known. Means are over the others.
        counts: How many pairs each counts as, and which are not independent; one each
            if None.
        confidence: The probability of the interval.

    Returns:
        The score with its standard error.

    Raises:
        InvalidInputError: If they have another shape, or a level is not in [0, 1].

    Example:
        >>> acauc_of(torch.tensor([[0.5], [1.0]])).value
        0.25
    """
    levels = read_unit_interval("levels", levels).double()
    mean, error, n = _mean_over_pairs(mean_of_known(levels, dim=1), counts)
    width = float("nan")
    if n > 1:
        reach = float(student.ppf((1 + confidence) / 2, n - 1))
        width = reach * error * (n / (n - 1)) ** 0.5
    return ACAUCScore(
        value=mean - 0.5,
        standard_error=error,
        interval=(mean - 0.5 - width, mean - 0.5 + width),
        per_parameter=means_of_pairs(levels, counts) - 0.5,
    )


def coverage_curve_of(levels: Tensor, counts: Counts | None = None) -> CoverageCurve:
    r"""Count the true parameters inside the interval of each nominal level.

    .. math:: c_j(\alpha) = \frac{1}{n} \sum_{i=1}^{n} \mathbf{1}[a^*_{ij} \le \alpha]

    With :math:`M` posterior samples the levels differ by multiples of
    :math:`2 / (M + 1)`, so that the curve is exact to about :math:`1 / M`.

    Args:
        levels: As in :func:`acauc_of`.
        counts: As in :func:`acauc_of`.

    Returns:
        The curve at .01, .02, ..., .99. Its number of observations is the effective
        one, rounded down.

    Raises:
        InvalidInputError: If they have another shape, or a level is not in [0, 1].
    """
    levels = read_unit_interval("levels", levels)
    nominal = _nominal_levels(levels)
    # One level at a time, so that no tensor is larger than `levels`.
    coverage, errors = [], []
    for alpha in nominal:
        inside = _inside(levels, alpha)
        coverage.append(means_of_pairs(inside, counts))
        errors.append(_mean_over_pairs(mean_of_known(inside, dim=1), counts)[1])
    return CoverageCurve(
        levels=nominal,
        per_parameter=torch.stack(coverage, dim=1),
        standard_error=nominal.new_tensor(errors),
        num_observations=int(_number_known(levels, counts) + ROUNDING),
    )


def expected_coverage_error_of(
    levels: Tensor, counts: Counts | None = None
) -> CoverageErrorScore:
    r"""Average the distance between empirical coverage and nominal level.

    .. math:: \text{ECE} = \frac{1}{99 d} \sum_{j=1}^{d} \sum_{l=1}^{99}
        \big| c_j(l / 100) - l / 100 \big|

    Unlike in ACAUC, the over-confidence of one parameter cannot cancel the
    under-confidence of another. The score is never negative, and a calibrated
    posterior scores about :math:`0.31 / \sqrt{n}` for any :math:`d`.

    The standard error is that of the score linearised at the observed curve, which is
    the infinitesimal jackknife over observations and needs no random numbers. The
    influence of an observation is the mean over parameters and levels of
    :math:`\operatorname{sign}(c_j - \alpha)(\mathbf{1}[a^*_{ij} \le \alpha] - c_j)`.
    The standard error is too large where the curve is close to the diagonal.

    Args:
        levels: As in :func:`acauc_of`.
        counts: As in :func:`acauc_of`.

    Returns:
        The score with its standard error.

    Raises:
        InvalidInputError: If they have another shape, or a level is not in [0, 1].
    """
    levels = read_unit_interval("levels", levels)
    nominal = _nominal_levels(levels)
    distance = levels.new_zeros(levels.shape[1], dtype=torch.float64)
    influence = levels.new_zeros(levels.shape[0], dtype=torch.float64)
    for alpha in nominal:
        inside = _inside(levels, alpha)
        gap = means_of_pairs(inside, counts) - alpha
        distance += gap.abs()
        influence += mean_of_known(gap.sign() * inside, dim=1)
    per_parameter, number = distance / nominal.numel(), _number_known(levels, counts)
    return CoverageErrorScore(
        value=float(mean_of_known(per_parameter, dim=0)),
        standard_error=_mean_over_pairs(influence / nominal.numel(), counts)[1],
        per_parameter=per_parameter,
        if_calibrated=0.31 / number**0.5 if number else math.nan,
    )


def _number_known(levels: Tensor, counts: Counts | None) -> float:
    """Return the number of complete observations that tell as much about a curve.

    A curve that is known at n of them has an error in proportion to 1 / sqrt(n). The
    mean of this error over parameters is kept. Zero if no level is known.
    """
    known = ~torch.isnan(levels)
    numbers = known.sum(dim=0).double()
    if counts is not None:
        kept = (counts[rows.to(counts.weights.device)] for rows in known.unbind(dim=1))
        numbers = numbers.new_tensor(
            [each.effective_number if len(each.weights) else 0.0 for each in kept]
        )
    numbers = numbers[numbers > 0]
    return float(numbers.rsqrt().mean() ** -2) if len(numbers) else 0.0


def _mean_over_pairs(
    values: Tensor, counts: Counts | None
) -> tuple[float, float, float]:
    """Return the mean of those that are not NaN, its error, and their number."""
    known = ~torch.isnan(values)
    values = values[known]
    if counts is None:
        return float(values.mean()), standard_error_of_mean(values), len(values)
    counts = counts[known.to(counts.weights.device)]
    if not len(values):
        return float("nan"), float("nan"), 0.0
    return *mean_and_error(values, counts), counts.effective_number


def read_unit_interval(name: str, values: Tensor) -> Tensor:
    """Return levels or ranks, shape ``(n, d)``, NaN allowed, in 32 bits or more."""
    numbers = as_numbers(name, values)
    numbers = as_batch(name, numbers, numbers.shape[-1:], finite=False)
    _in_unit_interval(name, numbers[~torch.isnan(numbers)])
    # In 16 bits, the nominal levels that they are compared with would be rounded too.
    return numbers if numbers.dtype == torch.double else numbers.float()


def _in_unit_interval(name: str, values: Tensor) -> Tensor:
    outside = ~((values >= 0) & (values <= 1 + ROUNDING_OF_LEVELS))  # NaN included
    if outside.any():
        raise InvalidInputError(
            f"Expected `{name}` in [0, 1]; got {float(values[outside][0])} and "
            f"{int(outside.sum()) - 1} others."
        )
    return values


def _nominal_levels(like: Tensor) -> Tensor:
    return torch.arange(1, 100, dtype=torch.float64, device=like.device) / 100


def _inside(levels: Tensor, alpha: Tensor) -> Tensor:
    inside = (levels <= alpha + ROUNDING).double()
    return inside.where(~torch.isnan(levels), torch.nan)
