r"""All scores of a posterior from one set of samples."""

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.metrics.calibration import (
    ACAUCScore,
    CoverageCurve,
    CoverageErrorScore,
    acauc_of,
    central_levels,
    coverage_curve_of,
    expected_coverage_error_of,
)
from sbi_rope.metrics.calls import (
    CHUNK_SIZE,
    check_num_samples,
    check_test_set,
    draw_ranks,
    evaluate_log_probs,
)
from sbi_rope.metrics.density import LPPScore, check_theta_std

__all__ = ["Evaluation", "evaluate"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """All scores of one posterior on one test set, from one set of samples.

    Attributes:
        lpp: Log-probabilities in the natural units of theta.
        lpp_z: The same with theta divided by ``theta_std``; None if that is unknown.
        ranks: Mid-ranks of the true parameters, shape ``(n, k)``; for instance
            ``acauc_of(evaluation.ranks)`` is the signed bias, kind ``"rank"``.
        acauc: Average coverage AUC of central intervals.
        coverage: Coverage of central intervals.
        expected_coverage_error: Distance of the coverage from the diagonal.
    """

    lpp: LPPScore
    lpp_z: LPPScore | None
    ranks: Tensor
    acauc: ACAUCScore
    coverage: CoverageCurve
    expected_coverage_error: CoverageErrorScore

    def as_row(self) -> dict[str, float]:
        """Return the headline numbers, NaN where one is unknown, as a table row."""
        return {
            "lpp": self.lpp.mean,
            "lpp_z": math.nan if self.lpp_z is None else self.lpp_z.mean,
            "lpp_median": self.lpp.median,
            "neg_inf_fraction": self.lpp.neg_inf_fraction,
            "acauc": self.acauc.value,
            "expected_coverage_error": self.expected_coverage_error.value,
        }


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
    """Score a posterior by log-probability and calibration, drawing samples once.

    Args:
        posterior: Any posterior with ``sample_batched`` and ``log_prob_batched``.
        theta: True parameters, shape ``(n, k)``.
        x: Their observations, shape ``(n, *event_shape)``.
        theta_std: Standard deviation of the prior, shape ``(k,)``, for ``lpp_z``.
        num_samples: Posterior samples drawn for each observation.
        seed: Seed of the samples; they also depend on ``chunk_size``.
        chunk_size: Observations treated at a time, which bounds the memory.
        show_progress_bars: Whether to show progress.

    Returns:
        The scores with their standard errors.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If the posterior has no ``log_prob_batched``.
    """
    theta, x = check_test_set(posterior, theta, x, chunk_size)
    check_num_samples(num_samples)
    check_theta_std(theta_std, theta)
    with seeded(seed):
        natural = LPPScore(
            log_probs=evaluate_log_probs(
                posterior, theta, x, chunk_size=chunk_size, show=show_progress_bars
            )
        )
        ranks = draw_ranks(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
    levels = central_levels(ranks)
    return Evaluation(
        lpp=natural,
        lpp_z=None if theta_std is None else natural.standardised(theta_std),
        ranks=ranks,
        acauc=acauc_of(levels),
        coverage=coverage_curve_of(levels),
        expected_coverage_error=expected_coverage_error_of(levels),
    )
