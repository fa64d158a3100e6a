r"""How often credible regions contain the true parameters."""

from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._validation import check_choice, check_integer
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
    draw_joint_levels,
    draw_ranks,
)

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
    r"""Average coverage AUC: the mean of :math:`a^*` minus one half.

    The kinds differ in what stands for the level :math:`a^*`:

    * ``"central"``: of one-dimensional central intervals, :math:`|2u - 1|` with
      :math:`u` the mid-rank of the parameter among its posterior samples. Positive if
      over-confident or biased, negative if under-confident. With :math:`M` samples it
      cannot fall below about :math:`-1/2 + 0.8 / \sqrt{M}`.
    * ``"hpd"``: of the joint highest-density region,
      :math:`P_{\theta' \sim \tilde p}(\tilde p(\theta') > \tilde p(\theta))`, which
      sees dependencies between parameters. One value for all parameters; with one
      parameter it is the one-dimensional region of highest density. Same signs.
    * ``"rank"``: :math:`u` itself, the algorithm printed in the paper's appendix,
      divided by the number of observations. It measures signed bias: positive if the
      truth lies above the posterior. Over- and under-confidence without bias give 0.
      The algorithm compares the sorted ranks with :math:`i / n`; here it is
      :math:`(i - 1/2) / n`, which sums to one half and gives 0 when calibrated.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4 and appendix, Computing ACAUC
        | https://arxiv.org/abs/2405.08719

    Args:
        posterior: Any posterior with ``sample_batched``; ``"hpd"`` also needs
            ``log_prob_batched``.
        theta: True parameters, shape ``(n, k)``.
        x: Their observations, shape ``(n, *event_shape)``.
        kind: What the regions are.
        num_samples: Posterior samples for each observation; 1000 by default, 200 for
            ``"hpd"``, which evaluates the density of every sample. Where that is slow,
            as for a mixture of many components, 50 cost little accuracy.
        num_observations: Use only this many observations, evenly spaced over the test
            set; all by default, at most 200 for ``"hpd"``.
        seed: Seed of the samples; they also depend on ``chunk_size``.
        chunk_size: Observations treated at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The score, its standard error, and the score of each parameter.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If ``"hpd"`` is asked of a posterior without density.
    """
    check_choice("kind", kind, list(DEFAULT_NUM_SAMPLES))
    theta, x = check_test_set(posterior, theta, x, chunk_size)
    if num_samples is None:
        num_samples = DEFAULT_NUM_SAMPLES[kind]
    if num_observations is None:
        num_observations = MAX_JOINT_OBSERVATIONS if kind == "hpd" else theta.shape[0]
    check_num_samples(num_samples)
    check_integer("num_observations", num_observations)
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
    """Coverage of central credible intervals at the levels .01, .02, ..., .99.

    Args:
        posterior: Any posterior with ``sample_batched``.
        theta: True parameters, shape ``(n, k)``.
        x: Their observations, shape ``(n, *event_shape)``.
        num_samples: Posterior samples drawn for each observation.
        seed: Seed of the samples; they also depend on ``chunk_size``.
        chunk_size: Observations treated at a time.
        show_progress_bars: Whether to show progress.

    Returns:
        The coverage of each parameter, its average, and the standard error of that.

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
    r"""Mean distance between coverage and level, over parameters and levels.

    A calibrated posterior scores about :math:`0.31 / \sqrt{n}`, never 0: see
    :func:`sbi_rope.metrics.calibration.expected_coverage_error_of`.

    Args:
        posterior: Any posterior with ``sample_batched``.
        theta: True parameters, shape ``(n, k)``.
        x: Their observations, shape ``(n, *event_shape)``.
        num_samples: Posterior samples drawn for each observation.
        seed: Seed of the samples; they also depend on ``chunk_size``.
        chunk_size: Observations treated at a time.
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
    theta, x = check_test_set(posterior, theta, x, chunk_size)
    check_num_samples(num_samples)
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
