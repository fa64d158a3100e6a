"""All scores of a posterior from one set of samples."""

import math
import textwrap
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sbi_rope._prior import PriorDistribution
from sbi_rope._random import seeded
from sbi_rope.metrics.by_estimate import (
    CoverageByEstimate,
    coverage_by_estimate,
    estimates_and_ranks,
    in_words,
)
from sbi_rope.metrics.calibration import (
    ACAUC_IN_WORDS,
    FEWEST,
    ACAUCScore,
    CoverageCurve,
    CoverageErrorScore,
    acauc_of,
    central_levels,
    coverage_curve_of,
    expected_coverage_error_of,
    random_ranks,
)
from sbi_rope.metrics.calls import (
    CHUNK_SIZE,
    NumSamples,
    draw_chunks,
    evaluate_log_probs,
    is_normalised,
    read_test_set,
)
from sbi_rope.metrics.density import LPPScore, read_units
from sbi_rope.settings import check, default_names

__all__ = ["Evaluation", "evaluate"]

GIVEN_UNITS = "units of `theta_std`"
PRIOR_UNITS = "standard deviations of the prior"


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """All scores of one posterior on one test set, from one set of samples.

    Print it for a summary. The attributes hold the scores with all their details.

    Attributes:
        lpp: The log-probabilities in the natural units of theta.
        lpp_z: The log-probabilities of theta in units of ``theta_std``, which are those
            of the prior if the posterior knows it; None if there are no units.
        ranks: The mid-ranks of the true parameters, shape ``(n, d)``. Other scores can
            be calculated from them: ``acauc_of(evaluation.ranks)`` is the ACAUC of kind
            ``"rank"``.
        acauc: The average coverage AUC of central intervals.
        coverage: The coverage of central intervals.
        expected_coverage_error: The distance of the coverage from the diagonal.
        by_estimate: Whether the coverage of 90 % intervals depends on the estimate.
        parameter_names: The names that the posterior has for the parameters; None if
            it has none.
        unit_z: The units of ``lpp_z`` in words.
        is_normalised: Whether the density is corrected for mass outside the prior; None
            if that is not known.
    """

    lpp: LPPScore
    lpp_z: LPPScore | None
    ranks: Tensor = field(repr=False)
    acauc: ACAUCScore
    coverage: CoverageCurve
    expected_coverage_error: CoverageErrorScore
    by_estimate: CoverageByEstimate
    parameter_names: tuple[str, ...] | None = field(default=None, repr=False)
    unit_z: str = GIVEN_UNITS
    is_normalised: bool | None = None

    def as_row(self) -> dict[str, float]:
        """Return the main scores as the row of a table; an unknown one is NaN."""
        return {
            "lpp": self.lpp.mean,
            "lpp_z": math.nan if self.lpp_z is None else self.lpp_z.mean,
            "lpp_median": self.lpp.median,
            "neg_inf_fraction": self.lpp.neg_inf_fraction,
            "acauc": self.acauc.value,
            "expected_coverage_error": self.expected_coverage_error.value,
        }

    def __str__(self) -> str:
        n, d = self.ranks.shape
        error = self.expected_coverage_error
        lines = [
            f"Scores on {n} observations, with {d} true parameters each",
            "  log probability of the true parameters (LPP), in nats an observation:",
            *self._densities(),
            f"  {self._verdict()}",
            f"    ({ACAUC_IN_WORDS})",
            f"  coverage error {error.value:.3f}; a calibrated posterior has about "
            f"{error.if_calibrated:.3f} with {n} observations",
            f"  50% intervals hold {self._inside(0.5):.0%} of the true parameters, 90% "
            f"intervals {self._inside(0.9):.0%}",
            *self._by_estimate(),
            "  all values: .lpp, .lpp_z, .ranks, .acauc, .coverage, "
            ".expected_coverage_error, .by_estimate",
        ]
        return "\n".join(lines)

    __repr__ = __str__  # which notebooks show

    def _verdict(self) -> str:
        value, (low, high) = f"ACAUC {self.acauc.value:+.3f}", self.acauc.interval
        if len(self.ranks) < FEWEST:
            return f"{value}, of too few observations to say what it means"
        verdict = self.acauc.verdict
        if verdict == "calibrated":
            verdict += " as far as these observations can tell"
        return f"{verdict}: {value}, 95 % interval {low:+.3f} to {high:+.3f}"

    def _by_estimate(self) -> list[str]:
        names = self.parameter_names or default_names(self.ranks.shape[1])
        return [
            part
            for line in in_words(self.by_estimate, names)
            for part in textwrap.wrap(
                line, 88, initial_indent="  ", subsequent_indent="    "
            )
        ]

    def _densities(self) -> list[str]:
        scores = {"theta in its own units": self.lpp}
        if self.lpp_z is not None:
            scores[f"theta in {self.unit_z}"] = self.lpp_z
        lines = [
            f"    {unit}: {score.mean:.2f} +- {score.standard_error:.2f}, "
            f"median {score.median:.2f}"
            for unit, score in scores.items()
        ]
        if self.lpp_z is None:
            lines.append(
                "    pass theta_std=prior.stddev for theta in standard deviations of "
                "the prior"
            )
        if self.is_normalised is not None:
            lines.append(
                "    corrected for mass outside the prior"
                if self.is_normalised
                else "    not corrected for mass outside the prior, which counts as an "
                "error"
            )
        if self.lpp.neg_inf_fraction:
            excluded = self.lpp.neg_inf_fraction
            lines.append(f"    {excluded:.1%} of the true parameters have density zero")
        return lines

    def _inside(self, level: float) -> float:
        """Return the share of true parameters in the central intervals of a level."""
        return float(self.coverage.average[round(100 * level) - 1])


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
        theta: True parameters, shape ``(n, d)``. Measurements with noise make a good
            posterior look over-confident.
        x: Their observations, shape ``(n, *event_shape)``.
        theta_std: The unit of each parameter for ``lpp_z``, shape ``(d,)``, and not
            the noise of ``theta``. If None, the standard deviations of the posterior's
            prior, estimated from draws if it does not state them.
        num_samples: The number of posterior samples for each observation, 20 or more.
        seed: The seed of the samples, which also depend on ``chunk_size``.
        chunk_size: How many observations are scored at a time. Fewer need less memory.
        show_progress_bars: Whether to show progress.

    Returns:
        The scores with their standard errors.

    Raises:
        InvalidInputError: If an argument has the wrong shape or is not finite, or the
            posterior returns NaN.
        LogProbUnavailableError: If the posterior has no ``log_prob_batched``.
    """
    theta, x = read_test_set(posterior, theta, x, chunk_size)
    check("num_samples", num_samples, NumSamples)
    unit_z = GIVEN_UNITS
    if theta_std is None:
        unit_z, theta_std = PRIOR_UNITS, _std_of_prior(posterior, theta)
    else:
        theta_std = read_units(theta_std, theta.shape[1])
    with seeded(seed):
        natural = LPPScore(
            log_probs=evaluate_log_probs(
                posterior, theta, x, chunk_size=chunk_size, show=show_progress_bars
            )
        )
        of_all, of_halves = [], []
        chunks = draw_chunks(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=chunk_size,
            show=show_progress_bars,
        )
        for rows, samples in chunks:
            of_all.append(random_ranks(samples, theta[rows]))
            of_halves.append(estimates_and_ranks(samples, theta[rows]))
    ranks = torch.cat(of_all)
    levels = central_levels(ranks)
    estimates, held_out = (torch.cat(parts) for parts in zip(*of_halves, strict=True))
    return Evaluation(
        lpp=natural,
        lpp_z=None if theta_std is None else natural.standardised(theta_std),
        ranks=ranks,
        acauc=acauc_of(levels),
        coverage=coverage_curve_of(levels),
        expected_coverage_error=expected_coverage_error_of(levels),
        by_estimate=coverage_by_estimate(held_out, estimates),
        parameter_names=getattr(posterior, "parameter_names", None),
        unit_z=unit_z,
        is_normalised=is_normalised(posterior),
    )


def _std_of_prior(posterior: Any, theta: Tensor) -> Tensor | None:
    """Return the standard deviations of a posterior's prior, if they can be known."""
    try:
        return read_units(
            PriorDistribution(posterior.prior).stddev.double().cpu(), theta.shape[1]
        )
    except Exception:  # posteriors of users, which need not have a prior to sample
        return None
