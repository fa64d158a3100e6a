"""The report of a stack: whether calibration helped, and how well it is calibrated."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

from torch import Tensor

from sbi_rope._statistics import TwoSampleTest
from sbi_rope.data import groups_of, one_of_each_group
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import (
    ACAUCScore,
    CoverageByEstimate,
    CoverageCurve,
    CoverageErrorScore,
)
from sbi_rope.metrics.by_estimate import coverage_by_estimate
from sbi_rope.metrics.calibration import acauc_of, expected_coverage_error_of
from sbi_rope.sets.conformal import rank_needed
from sbi_rope.settings import check
from sbi_rope.stacking.cross_validation import (
    CrossValidation,
    Difference,
    LearningCurve,
    SetScores,
)
from sbi_rope.stacking.words import LEVEL, REFERENCES, lines_of

__all__ = ["StackingReport"]


@dataclass(frozen=True, eq=False, kw_only=True)
class StackingReport:
    """How well a stack predicts held-out pairs, which methods it uses, and coverage.

    All numbers are computed on pairs that the candidates were not trained on. The
    weights of the stack that scores a pair are fitted to the scores of the other folds.

    Make a report with :meth:`of`, which computes all numbers once. Printing a report
    computes nothing.

    Attributes:
        cross_validation: The scores of all candidates and of the stack.
        learning_curve: The learning curve of the stack, if it was asked for.
        score: Mean held-out log score of the stack's normalised density, in nats a
            pair with theta in its own units, and its standard error.
        score_z: The same with theta in standard deviations of the prior. Scores of
            pairs differ by a constant, the sum of the logs of these standard deviations
            of the parameters that were measured. NaN if the prior has none.
        comparable_score: The same without correction for leakage, so that it can be
            compared with the scores of the candidates.
        gains: How much higher the stack scores than the candidates "prior" and "NPE",
            by name, if these are among the candidates. Compared with the prior the
            stack is normalised, as it is deployed. Compared with NPE, whose leakage is
            not corrected, it is not.
        family_weights: The weight of each method, summed over its settings, from the
            largest to the smallest.
        acauc: ACAUC of the stack's central intervals.
        coverage_error: Expected coverage error of the stack's central intervals.
        share_inside: Share of the parameters inside their 90 % intervals.
        joint_sets: Share of the pairs that are in their 90 % sets of highest density,
            and the level of such sets that are as large as those of 90 % with a
            guarantee. None if there are too few pairs for it.
        batch: How ``x_o`` compares with the observations of the pairs; None without
            it, or with fewer than five of either.
        discrepancy: What the pairs say about each entry of x. None if the stack has no
            discrepancy among its candidates, or x is not a short vector.
        provenance: How it was made, in words: the seed, the seconds, the simulator
            calls, when it was finished, and the versions of packages.
        acauc_of_parameters: ACAUC of each parameter by itself. The intervals are so
            wide that those of d calibrated parameters all hold 0 in at least 95 % of
            the cases (Bonferroni).
        by_estimate: Whether the coverage of the stack's 90 % intervals depends on the
            estimate.
        probability_of_prior: The probability that the parameters of the pairs were
            drawn from the prior, see :func:`~sbi_rope.discrepancy.learn_parameters`;
            None if it is not known.
        keep_prior: The names of the candidates that do not learn from the pairs how
            parameters are distributed.
        parameter_names: One name for each parameter; None if they have none.
    """

    cross_validation: CrossValidation
    learning_curve: LearningCurve | None
    score: tuple[float, float]
    comparable_score: tuple[float, float]
    gains: dict[str, Difference]
    family_weights: dict[str, float]
    acauc: ACAUCScore
    coverage_error: CoverageErrorScore
    share_inside: float
    score_z: tuple[float, float]
    acauc_of_parameters: tuple[ACAUCScore, ...]
    by_estimate: CoverageByEstimate
    joint_sets: tuple[float, float] | None = None
    batch: TwoSampleTest | None = None
    discrepancy: DiscrepancyReport | None = None
    provenance: dict[str, str] = field(default_factory=dict, repr=False)
    probability_of_prior: float | None = None
    keep_prior: tuple[str, ...] = ()
    parameter_names: tuple[str, ...] | None = None

    @classmethod
    def of(
        cls,
        cross_validation: CrossValidation,
        learning_curve: LearningCurve | None = None,
        **others: Any,
    ) -> "StackingReport":
        """Compute the report of a stack.

        Args:
            cross_validation: The scores of its candidates.
            learning_curve: The learning curve of the stack, if it was asked for.
            **others: The attributes that do not follow from these scores.
        """
        check("cross_validation", cross_validation, CrossValidation)
        check("learning_curve", learning_curve, LearningCurve | None)
        scores, levels = cross_validation, cross_validation.levels
        score, error = scores.mean_and_error(scores.stack_scores)
        return cls(
            cross_validation=scores,
            learning_curve=learning_curve,
            score=(score, error),
            score_z=scores.mean_and_error(
                scores.in_units_of_prior(scores.stack_scores)
            ),
            comparable_score=scores.mean_and_error(scores.scores_of("stack")),
            gains={
                name: scores.gain_over_prior()
                if name == "prior"
                else scores.difference("stack", name)
                for name in REFERENCES
                if name in scores.names
            },
            family_weights=_family_weights(scores),
            acauc=acauc_of(levels, scores.counts),
            coverage_error=expected_coverage_error_of(levels, scores.counts),
            share_inside=float(scores.coverage.average[round(100 * LEVEL) - 1]),
            joint_sets=_joint_sets(scores.set_scores),
            acauc_of_parameters=_acauc_of_parameters(scores),
            by_estimate=_by_estimate(scores),
            **others,
        )

    @property
    def learns_prior(self) -> bool:
        """Whether a candidate learns how parameters are distributed."""
        return len(self.keep_prior) < len(self.cross_validation.names)

    @property
    def score_of_prior_kept(self) -> float | None:
        """The best score of a candidate that does not learn the prior; None if none."""
        scores = self.cross_validation
        found = [
            scores.mean_and_error(scores.scores_of(name))[0] for name in self.keep_prior
        ]
        return max(found, default=None)

    @property
    def levels(self) -> Tensor:
        """The levels of held-out pairs, see :class:`CrossValidation`."""
        return self.cross_validation.levels

    @property
    def coverage(self) -> CoverageCurve:
        """Coverage of the stack's central intervals on held-out pairs."""
        return self.cross_validation.coverage

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate, the best held-out score first.

        The key "score" is the score with theta in its own units, and "score_z" that
        with theta in standard deviations of the prior. Both are in nats a pair.
        """
        rows = self.cross_validation.as_rows()
        return sorted(rows, key=lambda row: -row["score"])

    def to_html(
        self,
        path: str | PathLike[str],
        *,
        diagnosis: Any = None,
        parameter_names: Sequence[str] | None = None,
        x_names: Sequence[str] | None = None,
    ) -> None:
        """Write the report as one HTML file that can be sent to somebody.

        It is for readers who do not know this package. It holds the scores, weights,
        coverage and discrepancies with pictures, and how the stack was made. It needs
        no other file, no script and no network.

        Args:
            path: The file. Its folder is made if there is none. A report of this
                package that is there already is replaced, and no other file.
            diagnosis: What :func:`sbi_rope.diagnose` says about a batch, if the report
                should hold it.
            parameter_names: A name for each parameter. If None, those that ``RoPE`` was
                given, those of the diagnosis, or "theta_1" and so on.
            x_names: A name for each entry of x; "x[0]" and so on if None.

        Raises:
            InvalidInputError: If an argument has the wrong type, the names do not fit,
                or the path is a folder or a file of something else.
        """
        # This room draws with `plots`, which draws this report: it is above both.
        from sbi_rope.reports import write_stacking_report

        write_stacking_report(
            self,
            path,
            diagnosis=diagnosis,
            parameter_names=parameter_names,
            x_names=x_names,
        )

    def __str__(self) -> str:
        return "\n".join(lines_of(self))


def _acauc_of_parameters(scores: CrossValidation) -> tuple[ACAUCScore, ...]:
    columns = scores.levels.split(1, dim=1)
    confidence = 1 - 0.05 / len(columns)
    return tuple(
        acauc_of(column, scores.counts, confidence=confidence) for column in columns
    )


def _by_estimate(scores: CrossValidation) -> CoverageByEstimate:
    chosen = None
    if scores.groups is not None:
        chosen = one_of_each_group(groups_of(scores.groups), seed=0)
    return coverage_by_estimate(
        scores.ranks, scores.estimates, scores.counts, chosen=chosen, level=LEVEL
    )


def _joint_sets(scores: SetScores | None) -> tuple[float, float] | None:
    if scores is None or rank_needed(LEVEL, len(scores)) > len(scores):
        return None
    return scores.share_held(LEVEL), scores.level_needed(LEVEL)


def _family_weights(scores: CrossValidation) -> dict[str, float]:
    totals: dict[str, float] = {}
    weights = scores.weights.weights.tolist()
    for family, weight in zip(scores.families, weights, strict=True):
        totals[family] = totals.get(family, 0.0) + weight
    return dict(sorted(totals.items(), key=lambda item: -item[1]))
