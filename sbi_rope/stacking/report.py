"""The report of a stack: what out-of-fold scores say about it."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from sbi_rope.density.sets import SetScores
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.statistics import Estimate, TwoSampleTest
from sbi_rope.stacking.sections import sections_of, text_of
from sbi_rope.stacking.weights import (
    StackingWeights,
    fold_weights,
    stacking_weights,
)
from sbi_rope.utils.settings import Count, check, one_of


@dataclass(frozen=True, eq=False, kw_only=True)
class LearningCurve:
    """The out-of-fold scores of stacks that were trained on fewer pairs.

    Attributes:
        num_pairs: The numbers of pairs that each was trained on, ascending.
        evaluations: The scores of each stack, all at the same pairs.
    """

    num_pairs: tuple[int, ...]
    evaluations: tuple[Evaluation, ...] = field(repr=False)

    @property
    def scores(self) -> tuple[Estimate, ...]:
        """The LPP at each number of pairs. Differences have smaller errors."""
        return tuple(one.lpp for one in self.evaluations)

    @property
    def num_labels(self) -> int:
        """The number of pairs, or of their groups."""
        group = self.evaluations[0].group
        return len(self.evaluations[0]) if group is None else len(group.unique())

    def gain(self, num_more: int) -> Estimate:
        r"""Return how much more labels would add to the score, in nats a pair.

        The curve :math:`s_i(n) = a_i - b_i / n` is fitted to the scores of each
        hold-out pair i. A stack of n labels is the average of posteriors that were each
        trained on N of them, as the last point was. With m more labels each is trained
        on N (n + m) / n, and the gain is

        .. math:: \bar b \left( \frac{1}{N} - \frac{n}{N (n + m)} \right) .

        The interval takes the form of the curve as right.

        Args:
            num_more: m, the number of labels, or of groups, to add.

        Returns:
            The gain; NaN if the curve has a single point or a score is not finite.

        Raises:
            InvalidInputError: If the number is below 1.
        """
        check("num_more", num_more, Count)
        scores = torch.stack([one.log_prob for one in self.evaluations])
        if len(scores) < 2 or not torch.isfinite(scores).all():
            return Estimate(math.nan)
        inverse = torch.tensor(self.num_pairs).to(scores).reciprocal()
        centred = inverse - inverse.mean()
        slopes = -(centred @ scores) / centred.square().sum()
        last, n = self.num_pairs[-1], self.num_labels
        scale = 1 / last - n / (last * (n + num_more))
        return self.evaluations[0].mean(scale * slopes)


@dataclass(frozen=True, eq=False, kw_only=True)
class StackingReport:
    """How well a stack predicts hold-out pairs, what it is made of, and coverage.

    A candidate is scored at pairs of a fold by the version that was trained without
    this fold, and the stack at these pairs has the weights fitted to the other folds.
    With few pairs these weights still depend a little on the labels of the fold. What
    is deployed is the average of all versions. Print the report for what it found.

    With labels that are not exact, scores are log densities of the labels, and ranks
    are those of the labels, NaN where a parameter was not measured. Scores of labels
    given as draws are relative to the prior, and their ranks are not known.

    Attributes:
        names: The names of the K candidates.
        families: The method of each candidate.
        log_scores: The log density of the true parameters under each candidate, shape
            ``(n, K)``, not corrected for mass outside the prior.
        fold: The fold of each pair, shape ``(n,)``.
        num_trained_on: The mean number of pairs that the candidates were trained on.
        held_out: The scores of the stack at all pairs. Its density is normalised inside
            the support of the prior.
        set_scores: The scores that sets with a guarantee are made from; None if no
            label is exact.
        score_errors: The Monte-Carlo error of each score, if labels are not exact.
        labels: What is known of labels that are not exact, or weighted, in words.
        learning_curve: The learning curve of the stack, if it was asked for.
        batch: How ``x_o`` compares with the observations of the pairs; None without it,
            or with fewer than five of either.
        discrepancy: What the pairs say about each entry of x. None if no candidate has
            a discrepancy, or x is not a short vector.
        probability_of_prior: The probability that the parameters of the pairs were
            drawn from the prior, see :func:`~sbi_rope.discrepancy.learn_parameters`.
        keep_prior: The names of the candidates that do not learn from the pairs how
            parameters are distributed.
        provenance: How it was made, in words: seed, seconds, simulator calls, versions.
    """

    names: tuple[str, ...]
    families: tuple[str, ...]
    log_scores: Tensor = field(repr=False)
    fold: Tensor = field(repr=False)
    num_trained_on: int
    held_out: Evaluation
    set_scores: SetScores | None = field(default=None, repr=False)
    score_errors: Tensor | None = field(default=None, repr=False)
    labels: str = ""
    learning_curve: LearningCurve | None = None
    batch: TwoSampleTest | None = None
    discrepancy: DiscrepancyReport | None = None
    probability_of_prior: float | None = None
    keep_prior: tuple[str, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.fold)

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return int(self.fold.max()) + 1

    @cached_property
    def weights(self) -> StackingWeights:
        """The weights of the candidates, fitted to all pairs."""
        return stacking_weights(self.log_scores, pair_weights=self.held_out.weight)

    @property
    def family_weights(self) -> dict[str, float]:
        """The weight of each method, summed over its settings, the largest first."""
        totals = dict.fromkeys(self.families, 0.0)
        for family, weight in zip(
            self.families, self.weights.weights.tolist(), strict=True
        ):
            totals[family] += weight
        return dict(sorted(totals.items(), key=lambda item: -item[1]))

    @cached_property
    def comparable_scores(self) -> Tensor:
        """The scores of the stack without correction for mass outside the prior, (n,).

        Those of the candidates are not corrected either: for NPE on real data the
        correction may not end.
        """
        weights = fold_weights(self.log_scores, self.fold, self.held_out.weight)
        return torch.logsumexp(self.log_scores + weights[self.fold].log(), dim=1)

    def scores_of(self, name: str) -> Tensor:
        """Return the log scores of a candidate, or of "stack", shape ``(n,)``.

        They are not corrected for mass outside the prior.

        Raises:
            InvalidInputError: If there is no candidate of that name.
        """
        if name == "stack":
            return self.comparable_scores
        check("name", name, one_of((*self.names, "stack")))
        return self.log_scores[:, self.names.index(name)]

    def difference(self, name: str, other: str) -> Estimate:
        """Return by how much a candidate, or "stack", scores higher than another."""
        return self._gain(self.scores_of(name) - self.scores_of(other))

    @property
    def gains(self) -> dict[str, Estimate]:
        """How much higher the stack scores than the candidates "prior" and "NPE".

        Compared with the prior the stack is normalised, as it is deployed. Compared
        with NPE, which is not, it is not.
        """
        gains = {}
        if "NPE" in self.names:
            gains["NPE"] = self.difference("stack", "NPE")
        if "prior" in self.names:
            above = self.held_out.log_prob - self.scores_of("prior")
            gains["prior"] = self._gain(above)
        return gains

    def _gain(self, difference: Tensor) -> Estimate:
        # Where both scores are minus infinity, neither candidate is better.
        difference = difference.nan_to_num(nan=0.0, posinf=torch.inf, neginf=-torch.inf)
        return self.held_out.mean(difference)

    @property
    def score_of_prior_kept(self) -> float | None:
        """The best score of a candidate that does not learn the prior; None if none."""
        found = [self.held_out.mean(self.scores_of(k)).mean for k in self.keep_prior]
        return max(found, default=None)

    @property
    def monte_carlo_error(self) -> float:
        """The error of the mean score that comes from labels not being exact."""
        if self.score_errors is None:
            return 0.0
        weight = self.held_out.weight
        weight = torch.ones_like(self.score_errors) if weight is None else weight
        return float((weight * self.score_errors).norm() / weight.sum())

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate, the best out-of-fold score first.

        The key "score" is the LPP with theta in its own units, and "score_z" that with
        theta in standard deviations of the prior. Both have a "low" and a "high" end.
        """
        rows, unit = [], self.held_out.log_unit
        for name, family, weight, scores in zip(
            self.names,
            self.families,
            self.weights.weights.tolist(),
            self.log_scores.unbind(dim=1),
            strict=True,
        ):
            row: dict[str, Any] = {"candidate": name, "family": family}
            row["weight"] = weight
            for key, values in (("score", scores), ("score_z", scores + unit)):
                found = self.held_out.mean(values)
                row |= {key: found.mean, f"{key}_low": found.low}
                row[f"{key}_high"] = found.high
            rows.append(row)
        return sorted(rows, key=lambda row: -row["score"])

    def __str__(self) -> str:
        return text_of(self, sections_of(self))
