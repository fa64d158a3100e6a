"""Scores of how often credible regions contain the true parameters."""

from typing import Any, Literal

import torch
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
    NumSamples,
    draw_joint_levels,
    draw_ranks,
    read_test_set,
)
from sbi_rope.settings import Count, check, one_of

__all__ = ["acauc", "coverage_curve", "expected_coverage_error"]

MAX_JOINT_OBSERVATIONS = 200
DEFAULT_NUM_SAMPLES = {"central": 1000, "rank": 1000, "hpd": 200}


def acauc(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    kind: Literal["central", "hpd", "rank"] = "central",
    num_samples: int | None = None,
    num_observations: int | None = None,
    seed: int | None = None,
    chunk_size: int = CHUNK_SIZE,
    show_progress_bars: bool = False,
) -> ACAUCScore:
    r"""Return the average coverage AUC: the mean of :math:`a^*` minus one half.

    The kinds differ in the level :math:`a^*`:

    * ``"central"``: The level of one-dimensional central intervals, :math:`|2u - 1|`,
      where :math:`u` is the mid-rank of the parameter among its posterior samples. The
      score is positive if the posterior is over-confident or biased, and negative if it
      is under-confident. With :math:`M` samples it cannot fall below about
      :math:`-1/2 + 0.8 / \sqrt{M}`.
    * ``"hpd"``: The level of the joint region of highest density,
      :math:`P_{\theta' \sim \tilde p}(\tilde p(\theta') > \tilde p(\theta))`, which
      also depends on how the parameters are correlated. There is one value for all
      parameters, and its sign means the same as for ``"central"``.
    * ``"rank"``: The rank :math:`u` itself. This is the algorithm printed in the
      paper's appendix, divided by the number of observations. It measures signed bias:
      the score is positive if the truth lies above the posterior, and zero for over- or
      under-confidence without bias. The algorithm compares the sorted ranks with
      :math:`i / n`. Here they are compared with :math:`(i - 1/2) / n`, whose mean is
      one half, so that a calibrated posterior scores 0.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4 and appendix, Computing ACAUC
        | https://arxiv.org/abs/2405.08719

    Args:
        posterior: Any posterior with ``sample_batched``. The kind ``"hpd"`` also needs
            ``log_prob_batched``.
        theta: True parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event_shape)``.
        kind: The credible regions, as above.
        num_samples: The number of posterior samples for each observation, 20 or more.
            The default is 1000, or 200 for ``"hpd"``, which evaluates the density of
            every sample. Where that is slow, as for a mixture of many components, 50
            samples lose little accuracy.
        num_observations: How many observations are used. They are evenly spaced over
            the test set. The default is all, or at most 200 for ``"hpd"``.
        seed: The seed of the samples, which also depend on ``chunk_size``.
        chunk_size: How many observations are scored at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The score, its standard error, and the score of each parameter.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If the kind is ``"hpd"`` and the posterior has no
            ``log_prob_batched``.
    """
    check("kind", kind, one_of(list(DEFAULT_NUM_SAMPLES)))
    theta, x = read_test_set(posterior, theta, x, chunk_size)
    if num_samples is None:
        num_samples = DEFAULT_NUM_SAMPLES[kind]
    if num_observations is None:
        num_observations = MAX_JOINT_OBSERVATIONS if kind == "hpd" else theta.shape[0]
    check("num_samples", num_samples, NumSamples)
    check("num_observations", num_observations, Count)
    theta, x = _thin(theta, x, num_observations)
    draw = draw_joint_levels if kind == "hpd" else draw_ranks
    with seeded(seed):
        values = draw(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
    return acauc_of(central_levels(values) if kind == "central" else values)


def coverage_curve(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int = 1000,
    seed: int | None = None,
    chunk_size: int = CHUNK_SIZE,
    show_progress_bars: bool = False,
) -> CoverageCurve:
    """Return the coverage of central intervals at the levels .01, .02, ..., .99.

    Args:
        posterior: Any posterior with ``sample_batched``.
        theta: True parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event_shape)``.
        num_samples: The number of posterior samples for each observation, 20 or more.
        seed: The seed of the samples, which also depend on ``chunk_size``.
        chunk_size: How many observations are scored at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The coverage of each parameter, their average, and its standard error.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
    """
    return coverage_curve_of(
        _central_levels(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            seed=seed,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
    )


def expected_coverage_error(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int = 1000,
    seed: int | None = None,
    chunk_size: int = CHUNK_SIZE,
    show_progress_bars: bool = False,
) -> CoverageErrorScore:
    r"""Return the mean distance between coverage and level.

    The mean is over parameters and levels. A calibrated posterior does not score 0 but
    about :math:`0.31 / \sqrt{n}`: see
    :func:`sbi_rope.metrics.expected_coverage_error_of`.

    Args:
        posterior: Any posterior with ``sample_batched``.
        theta: True parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event_shape)``.
        num_samples: The number of posterior samples for each observation, 20 or more.
        seed: The seed of the samples, which also depend on ``chunk_size``.
        chunk_size: How many observations are scored at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The score, its standard error, and the score of each parameter.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
    """
    return expected_coverage_error_of(
        _central_levels(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            seed=seed,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
    )


def _central_levels(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int,
    seed: int | None,
    chunk_size: int,
    show: bool,
) -> Tensor:
    theta, x = read_test_set(posterior, theta, x, chunk_size)
    check("num_samples", num_samples, NumSamples)
    with seeded(seed):
        ranks = draw_ranks(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=chunk_size,
            show=show,
        )
    return central_levels(ranks)


def _thin(theta: Tensor, x: Tensor, number: int) -> tuple[Tensor, Tensor]:
    if number >= theta.shape[0]:
        return theta, x
    rows = torch.linspace(0, theta.shape[0] - 1, number, device=theta.device)
    return theta[rows.round().long()], x[rows.round().long()]
