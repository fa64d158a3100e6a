r"""Calibration scores as functions of ranks and credible levels alone.

For nested credible regions, let :math:`a^*` be the level of the smallest region that
contains the true parameter. A calibrated posterior has :math:`a^* \sim U(0, 1)`, an
over-confident one has it too large. Every score here is a mean over :math:`a^*`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._validation import (
    check_batch,
    check_device,
    check_not_nan,
    check_tensor,
    check_values,
)
from sbi_rope.errors import InvalidInputError

__all__ = [
    "ACAUCScore",
    "CoverageCurve",
    "CoverageErrorScore",
    "acauc_of",
    "central_levels",
    "count_ranks",
    "coverage_curve_of",
    "expected_coverage_error_of",
    "mid_ranks",
    "standard_error_of_mean",
]

# Levels and ranks are ratios of integers: equality must survive their rounding.
ROUNDING = 1e-9
# What a level may be beyond 1, such as one that was calculated in float32.
ROUNDING_OF_LEVELS = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class ACAUCScore:
    """Average coverage AUC: positive if over-confident, zero if calibrated.

    Attributes:
        value: Mean over parameters and observations, in [-1/2, 1/2].
        standard_error: Of ``value``, over observations (parameters of one observation
            are not taken as independent); NaN for a single observation.
        per_parameter: Mean over observations, shape ``(k,)``; ``(1,)`` for joint
            regions.
    """

    value: float
    standard_error: float
    per_parameter: Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class CoverageCurve:
    """Share of true parameters inside the central credible interval of each level.

    Attributes:
        levels: Nominal levels .01, .02, ..., .99, shape ``(99,)``.
        per_parameter: Empirical coverage, shape ``(k, 99)``.
        standard_error: Of ``average``, over observations, shape ``(99,)``.
        num_observations: Size of the test set.
    """

    levels: Tensor
    per_parameter: Tensor
    standard_error: Tensor
    num_observations: int

    @property
    def average(self) -> Tensor:
        """Coverage averaged over parameters, shape ``(99,)``."""
        return self.per_parameter.mean(dim=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class CoverageErrorScore:
    """Mean absolute distance of the coverage curves from the diagonal.

    Attributes:
        value: Mean over parameters and levels, in [0, 1/2].
        standard_error: Of ``value``, over observations, to first order.
        per_parameter: Mean over levels, shape ``(k,)``.
    """

    value: float
    standard_error: float
    per_parameter: Tensor


def mid_ranks(samples: Tensor, theta: Tensor) -> Tensor:
    r"""Posterior distribution function at the true parameter, estimated from samples.

    .. math:: u_{ij} = \frac{1}{M + 1} \Big( \tfrac{1}{2}
        + \#\{m: \theta^m_{ij} < \theta_{ij}\}
        + \tfrac{1}{2} \#\{m: \theta^m_{ij} = \theta_{ij}\} \Big)

    Ties are split, so that neither side of an atom is favoured.

    Args:
        samples: Posterior samples, shape ``(M, n, k)``.
        theta: True parameters, shape ``(n, k)``.

    Returns:
        The ranks, strictly between 0 and 1, float64, shape ``(n, k)``.

    Raises:
        InvalidTypeError: If an argument is no tensor of real numbers.
        InvalidInputError: If a shape does not fit, there is no sample, or there is a
            NaN, which is neither above nor below anything. Infinite values are.

    Example:
        >>> mid_ranks(torch.tensor([[[0.0]], [[1.0]], [[1.0]]]), torch.tensor([[1.0]]))
        tensor([[0.6250]], dtype=torch.float64)
    """
    check_tensor("samples", samples)
    check_batch("theta", theta, check_tensor("theta", theta).shape[-1:], finite=False)
    if samples.ndim != 3 or samples.shape[1:] != theta.shape or not len(samples):
        raise InvalidInputError(
            f"Expected `samples` of shape (M, {theta.shape[0]}, {theta.shape[1]}) with "
            f"M >= 1, for `theta` of shape {tuple(theta.shape)}; got "
            f"{tuple(samples.shape)}."
        )
    check_device("theta", theta, samples.device, where="`samples`")
    check_not_nan("samples", samples)
    check_not_nan("theta", theta)
    return count_ranks(samples, theta)


def count_ranks(samples: Tensor, theta: Tensor) -> Tensor:
    """Return :func:`mid_ranks` of arguments that are known to be right."""
    below = (samples < theta).sum(dim=0).double()
    equal = (samples == theta).sum(dim=0).double()
    return (below + equal / 2 + 0.5) / (samples.shape[0] + 1)


def central_levels(ranks: Tensor) -> Tensor:
    r"""Level of the smallest central interval containing theta, :math:`|2u - 1|`.

    Args:
        ranks: Posterior distribution function at the true parameters, any shape.

    Returns:
        The levels, same shape.

    Raises:
        InvalidTypeError: If the ranks are no tensor of real numbers.
        InvalidInputError: If a rank is not in [0, 1].
    """
    _check_unit_range("ranks", check_tensor("ranks", ranks))
    return (2.0 * ranks - 1.0).abs()


def acauc_of(levels: Tensor) -> ACAUCScore:
    r"""Average the coverage error over all levels, parameters and observations.

    .. math:: \text{ACAUC} = \frac{1}{k n} \sum_{j=1}^{k} \sum_{i=1}^{n} \int_0^1
        \alpha - \mathbf{1}[\theta_{ij} \in \Theta_{ij}(\alpha)] \,\mathrm{d}\alpha
        = \frac{1}{k n} \sum_{j, i} a^*_{ij} - \frac{1}{2},

    because the regions :math:`\Theta(\alpha)` are nested and contain theta from the
    level :math:`a^*` on.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Metrics
        | https://arxiv.org/abs/2405.08719

    Args:
        levels: The levels :math:`a^*`, shape ``(n, k)``.

    Returns:
        The score with its standard error.

    Raises:
        InvalidTypeError: If the levels are no tensor of real numbers.
        InvalidInputError: If their shape is another one, or a level is not in [0, 1].

    Example:
        >>> acauc_of(torch.tensor([[0.5], [1.0]])).value
        0.25
    """
    levels = _checked_levels(levels).double()
    per_observation = levels.mean(dim=1)
    return ACAUCScore(
        value=float(per_observation.mean() - 0.5),
        standard_error=standard_error_of_mean(per_observation),
        per_parameter=levels.mean(dim=0) - 0.5,
    )


def coverage_curve_of(levels: Tensor) -> CoverageCurve:
    r"""Count the true parameters inside the interval of each nominal level.

    .. math:: c_j(\alpha) = \frac{1}{n} \sum_{i=1}^{n} \mathbf{1}[a^*_{ij} \le \alpha]

    With :math:`M` posterior samples the levels are multiples of :math:`2 / (M + 1)`
    apart: the curve is exact to about :math:`1 / M`.

    Args:
        levels: The levels :math:`a^*`, shape ``(n, k)``.

    Returns:
        The curve at .01, .02, ..., .99.

    Raises:
        InvalidTypeError: If the levels are no tensor of real numbers.
        InvalidInputError: If their shape is another one, or a level is not in [0, 1].
    """
    levels = _checked_levels(levels)
    nominal = _nominal_levels(levels)
    # One level at a time: memory stays that of `levels`, whatever n and k.
    coverage, errors = [], []
    for alpha in nominal:
        inside = _inside(levels, alpha)
        coverage.append(inside.mean(dim=0))
        errors.append(standard_error_of_mean(inside.mean(dim=1)))
    return CoverageCurve(
        levels=nominal,
        per_parameter=torch.stack(coverage, dim=1),
        standard_error=nominal.new_tensor(errors),
        num_observations=levels.shape[0],
    )


def expected_coverage_error_of(levels: Tensor) -> CoverageErrorScore:
    r"""Average the distance between empirical coverage and nominal level.

    .. math:: \text{ECE} = \frac{1}{99 k} \sum_{j=1}^{k} \sum_{l=1}^{99}
        \big| c_j(l / 100) - l / 100 \big|

    Unlike ACAUC it does not let one parameter's over-confidence cancel another's
    under-confidence. It is therefore never negative: a calibrated posterior scores
    about :math:`0.31 / \sqrt{n}`, whatever :math:`k`. The standard error is that of
    the score linearised at the observed curve (the infinitesimal jackknife over
    observations, which needs no random numbers):
    each observation's influence is the mean of
    :math:`\operatorname{sign}(c_j - \alpha)(\mathbf{1}[a^*_{ij} \le \alpha] - c_j)`.
    It is too large where the curve is close to the diagonal.

    Args:
        levels: The levels :math:`a^*`, shape ``(n, k)``.

    Returns:
        The score with its standard error.

    Raises:
        InvalidTypeError: If the levels are no tensor of real numbers.
        InvalidInputError: If their shape is another one, or a level is not in [0, 1].
    """
    levels = _checked_levels(levels)
    nominal = _nominal_levels(levels)
    distance = levels.new_zeros(levels.shape[1], dtype=torch.float64)
    influence = levels.new_zeros(levels.shape[0], dtype=torch.float64)
    for alpha in nominal:
        inside = _inside(levels, alpha)
        gap = inside.mean(dim=0) - alpha
        distance += gap.abs()
        influence += (gap.sign() * inside).mean(dim=1)
    per_parameter = distance / nominal.numel()
    return CoverageErrorScore(
        value=float(per_parameter.mean()),
        standard_error=standard_error_of_mean(influence / nominal.numel()),
        per_parameter=per_parameter,
    )


def standard_error_of_mean(values: Tensor) -> float:
    """Standard error of the mean of a vector: NaN for one value, Inf if any is."""
    if values.numel() < 2:
        return float("nan")
    if torch.isinf(values).any():
        return float("inf")
    return float(values.double().std() / values.numel() ** 0.5)


def _checked_levels(levels: Tensor) -> Tensor:
    """Return levels (n, k) without their gradients, which no score has a use for."""
    shape = check_tensor("levels", levels).shape
    if levels.ndim != 2:
        raise InvalidInputError(
            f"Expected `levels` of shape (n, k); got {tuple(shape)}."
        )
    check_batch("levels", levels, shape[1:], finite=False)
    _check_unit_range("levels", levels)
    levels = levels.detach()
    # Of 16 bits, they would be compared with levels that have been rounded as coarsely.
    is_coarse = levels.dtype in (torch.float16, torch.bfloat16)
    return levels.float() if is_coarse else levels


def _check_unit_range(name: str, values: Tensor) -> None:
    check_values(name, values)
    outside = ~((values >= 0) & (values <= 1 + ROUNDING_OF_LEVELS))  # NaN included
    if outside.any():
        raise InvalidInputError(
            f"Expected `{name}` in [0, 1]; got NaN or numbers outside in "
            f"{int(outside.sum())} of {values.numel()} places, such as "
            f"{float(values[outside][0])}."
        )


def _nominal_levels(like: Tensor) -> Tensor:
    return torch.arange(1, 100, dtype=torch.float64, device=like.device) / 100


def _inside(levels: Tensor, alpha: Tensor) -> Tensor:
    return (levels <= alpha + ROUNDING).double()
