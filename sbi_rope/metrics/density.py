"""The log-probability of the true parameters under the posterior."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sbi_rope._statistics import standard_error_of_mean
from sbi_rope.metrics.calls import CHUNK_SIZE, evaluate_log_probs, read_test_set
from sbi_rope.settings import Positive, check
from sbi_rope.tensors import as_batch

__all__ = ["LPPScore", "lpp", "read_units"]


@dataclass(frozen=True, eq=False, kw_only=True)
class LPPScore:
    r"""Log-probabilities of the true parameters under the posterior. Higher is better.

    Attributes:
        log_probs: One value for each observation, in nats, float64, shape ``(n,)``. It
            is :math:`-\infty` where the posterior excludes the true parameter.
    """

    log_probs: Tensor = field(repr=False)

    def __str__(self) -> str:
        return f"{self.mean:.2f} +- {self.standard_error:.2f}"

    __repr__ = __str__  # which notebooks show

    @property
    def mean(self) -> float:
        r"""The LPP. It is :math:`-\infty` if a single true parameter is excluded."""
        return float(self.log_probs.mean())

    @property
    def standard_error(self) -> float:
        """The standard error of the mean; infinite if the mean is infinite."""
        return standard_error_of_mean(self.log_probs)

    @property
    def median(self) -> float:
        """The median, which a few excluded parameters change little."""
        return float(self.log_probs.quantile(0.5, interpolation="nearest"))

    @property
    def neg_inf_fraction(self) -> float:
        r"""The share of true parameters with a log-probability of :math:`-\infty`."""
        return float(torch.isneginf(self.log_probs).double().mean())

    def standardised(self, theta_std: Tensor) -> "LPPScore":
        r"""Return the score of the same posterior for parameters in other units.

        The density of :math:`z_j = \theta_j / s_j` is
        :math:`p(z \mid x) = p(\theta \mid x) \prod_j s_j`.

        Args:
            theta_std: The units :math:`s`, positive, shape ``(d,)``.
        """
        shift = read_units(theta_std).to(self.log_probs).log().sum()
        return LPPScore(log_probs=self.log_probs + shift)


def lpp(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    theta_std: Tensor | None = None,
    chunk_size: int = CHUNK_SIZE,
    show_progress_bars: bool = False,
) -> LPPScore:
    r"""Return the log posterior probability (LPP) of the true parameters.

    .. math:: \text{LPP} = \frac{1}{n} \sum_{i=1}^{n}
        \log \tilde p(\theta_i \mid x_i)

    Parameters are in their natural units unless ``theta_std`` is given. To have both
    without evaluating the posterior twice, call :meth:`LPPScore.standardised` on the
    result in natural units. Values of :math:`-\infty` stay in the mean, and their share
    is reported.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Metrics
        | https://arxiv.org/abs/2405.08719

    Args:
        posterior: Any posterior with ``log_prob_batched``.
        theta: True parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event_shape)``.
        theta_std: The units of theta, usually the prior's standard deviation, shape
            ``(d,)``.
        chunk_size: How many observations are scored at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The log-probabilities, with their mean, standard error, median, and share of
        :math:`-\infty`.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If the posterior has no ``log_prob_batched``.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.density import PriorPosterior
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> score = lpp(PriorPosterior(prior), torch.rand(9, 1), torch.rand(9, 2))
        >>> score.mean
        0.0
    """
    theta, x = read_test_set(posterior, theta, x, chunk_size)
    if theta_std is not None:
        theta_std = read_units(theta_std, theta.shape[1])
    score = LPPScore(
        log_probs=evaluate_log_probs(
            posterior, theta, x, chunk_size=chunk_size, show=show_progress_bars
        )
    )
    return score if theta_std is None else score.standardised(theta_std)


def read_units(theta_std: Tensor, count: int | None = None) -> Tensor:
    """Return the unit of each parameter, which is positive."""
    units = as_batch("theta_std", theta_std, (), rows=count)
    check("theta_std", float(units.min()), Positive)
    return units
