"""Held-out scores of candidates and of their stack, and what follows from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.stats import bootstrap, norm
from scipy.stats import t as student
from torch import Tensor

from sbi_rope._means import counts_of, interval_of_mean, mean_and_error
from sbi_rope.data import Counts
from sbi_rope.metrics import CoverageCurve
from sbi_rope.metrics.calibration import coverage_curve_of_pairs
from sbi_rope.sets.conformal import check_enough, rank_needed
from sbi_rope.settings import Count, check, one_of
from sbi_rope.stacking.weights import StackingWeights, stacking_weights

__all__ = [
    "CrossValidation",
    "Difference",
    "LearningCurve",
    "SetScores",
    "fold_weights",
]

NUM_BOOTSTRAP = 2000
# Means of resampled pairs are never outside the range of the pairs. With two, three and
# four pairs it holds the true mean in 50, 75 and 87 % of the cases only.
FEWEST_TO_RESAMPLE = 5


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A mean difference of log scores, pair by pair, with its 95 % interval.

    Attributes:
        mean: The mean over pairs.
        low: Lower end of the interval.
        high: Upper end.

    The interval is a percentile interval of the bootstrap whose level is widened, as
    the interval of Student's t is wider than that of a normal distribution. Otherwise
    the true difference would be outside too often if there are few pairs. With fewer
    than five pairs it is the interval of Student's t itself.

    References:
        | What Teachers Should Know about the Bootstrap (Hesterberg, 2015), section 4.4
        | https://arxiv.org/abs/1411.5279
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SetScores:
    """The held-out scores that sets with a guarantee are made from.

    Attributes:
        joint: The level of the smallest set of highest density that contains the true
            parameters, shape ``(n,)``. It is above 1 if their density is lower than
            that of all draws, see :func:`sbi_rope.sets.conformal.joint_scores`.
        marginal: The level of the smallest central interval of each parameter that
            contains the true one, shape ``(n, d)``. It is above 1 beyond all draws, see
            :func:`sbi_rope.sets.conformal.marginal_scores`.
        is_counted: The pairs that count, shape ``(n,)``. Those of one group are not
            exchangeable one by one. One of them counts, chosen at random. Pairs whose
            label is not exact do not count, and their scores are NaN.
        weights: The weights of the stack that scored each fold, shape ``(F, K)``.
        num_draws: The number of draws that the scores were computed from.
    """

    joint: Tensor
    marginal: Tensor
    is_counted: Tensor
    weights: Tensor
    num_draws: int

    def __len__(self) -> int:
        return int(self.is_counted.sum())

    def share_held(self, level: float) -> float:
        """Return the share of pairs in their sets of highest density of a level."""
        return float((self.joint[self.is_counted] <= level).double().mean())

    def level_needed(self, level: float) -> float:
        """Return the level of the sets of highest density that a guarantee needs.

        A set with a guarantee is about as large as a set of highest density of this
        level. Above 1 it reaches further than all draws.

        Raises:
            InvalidInputError: If there are too few pairs for the level.
        """
        check_enough(level, len(self))
        rank = rank_needed(level, len(self))
        return float(self.joint[self.is_counted].kthvalue(rank).values)


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossValidation:
    """The scores of candidates on held-out calibration pairs.

    The candidates have not seen the labels of the fold that they are scored on. The
    weights of the stack that scores a fold are fitted to the scores of the other folds.
    The candidates behind those scores have seen the fold, so that with few pairs the
    weights still depend a little on its labels.

    Attributes:
        names: The names of the K candidates.
        families: The method of each candidate.
        log_scores: Log density of the true parameters, shape ``(n, K)``, not corrected
            for leakage.
        fold: The fold of each pair, shape ``(n,)``.
        num_trained_on: The mean number of pairs that the candidates were trained on,
            rounded down.
        stack_scores: Log density of each pair under the stack, shape ``(n,)``,
            normalised inside the support of the prior as the stack's ``log_prob`` is.
        levels: The levels of the stack's central intervals that end at the true
            parameters, shape ``(n, d)``. They are uniform if the stack is calibrated.
        estimates: The means of the stack at each pair, shape ``(n, d)``.
        ranks: The ranks of the true parameters in the stack, shape ``(n, d)``. They
            come from other draws than the means, see
            :func:`~sbi_rope.metrics.coverage_by_estimate`. They are NaN where the
            levels are.
        log_unit: The sum of the logs of the prior's standard deviations; NaN if it is
            unknown. Scores with theta in these units are higher by this number. With
            partial labels it is that of each pair, the sum over measured parameters,
            shape ``(n,)``.
        set_scores: The scores that sets with a guarantee are made from; None if no
            label is exact.
        pair_weights: How many pairs each pair counts as, shape ``(n,)``. Pairs of one
            group share the weight of one. None if all count as one.
        groups: A number for each pair, the same for pairs of one person or specimen,
            shape ``(n,)``; None if all differ. Errors and intervals are those of means
            of groups, because pairs of a group are not independent.
        score_errors: The Monte-Carlo errors of ``stack_scores``, if labels are not
            exact.
        labels: What is known of labels that are not exact, or weighted, in words.

    With labels that are not exact, scores are log densities of the labels, and levels
    are those of the labels, NaN where a parameter was not measured. Scores of labels
    given as draws are relative to the prior, and their levels are unknown.
    """

    names: tuple[str, ...]
    families: tuple[str, ...]
    log_scores: Tensor = field(repr=False)
    fold: Tensor = field(repr=False)
    num_trained_on: int
    stack_scores: Tensor = field(repr=False)
    levels: Tensor = field(repr=False)
    estimates: Tensor = field(repr=False)
    ranks: Tensor = field(repr=False)
    log_unit: float | Tensor = float("nan")
    pair_weights: Tensor | None = field(default=None, repr=False)
    groups: Tensor | None = field(default=None, repr=False)
    score_errors: Tensor | None = field(default=None, repr=False)
    labels: str = ""
    set_scores: SetScores | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.fold)

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return int(self.fold.max()) + 1

    @cached_property
    def weights(self) -> StackingWeights:
        """The weights of the candidates, fitted to all pairs."""
        return stacking_weights(self.log_scores, pair_weights=self.pair_weights)

    @property
    def counts(self) -> Counts | None:
        """How many pairs each counts as; None if all are independent and count one."""
        return counts_of(self.pair_weights, self.groups)

    @property
    def effective_number(self) -> float:
        """The number of independent pairs of equal weight with the same precision."""
        counts = self.counts
        return float(len(self)) if counts is None else counts.effective_number

    @property
    def monte_carlo_error(self) -> float:
        """The error of the mean stack score that comes from labels not being exact."""
        if self.score_errors is None:
            return 0.0
        weights = torch.ones_like(self.score_errors)
        if self.pair_weights is not None:
            weights = self.pair_weights.to(weights)
        return float((weights * self.score_errors).norm() / weights.sum())

    def in_units_of_prior(self, scores: Tensor) -> Tensor:
        """Return scores of the pairs with theta in the prior's standard deviations."""
        unit = self.log_unit
        return scores + (unit.to(scores) if isinstance(unit, Tensor) else unit)

    def mean_and_error(self, scores: Tensor) -> tuple[float, float]:
        """Return the weighted mean of a score of each pair, and its standard error."""
        return mean_and_error(scores, self.counts)

    @cached_property
    def comparable_stack_scores(self) -> Tensor:
        """Log density of each pair under the stack, not corrected for leakage.

        The scores of the candidates are not corrected either, so that the two can be
        compared.
        """
        weights = fold_weights(
            self.log_scores, self.fold, pair_weights=self.pair_weights
        )
        return torch.logsumexp(self.log_scores + weights[self.fold].log(), dim=1)

    @property
    def coverage(self) -> CoverageCurve:
        """Coverage of the stack's central intervals on held-out pairs."""
        return coverage_curve_of_pairs(self.levels, self.counts)

    def scores_of(self, name: str) -> Tensor:
        """Return the log scores of a candidate, or of "stack", shape ``(n,)``.

        They are not corrected for leakage, so that they can be compared.

        Raises:
            InvalidInputError: If there is no candidate of that name.
        """
        if name == "stack":
            return self.comparable_stack_scores
        check("name", name, one_of((*self.names, "stack")))
        return self.log_scores[:, self.names.index(name)]

    def difference(self, name: str, other: str) -> Difference:
        """Return by how much one candidate scores higher than another.

        Args:
            name: A candidate, or "stack".
            other: Another candidate, or "stack".

        Raises:
            InvalidInputError: If there is no candidate of that name.
        """
        return self._difference(self.scores_of(name) - self.scores_of(other))

    def gain_over_prior(self) -> Difference:
        """Return by how much the normalised stack scores higher than the prior.

        No density of the prior is outside the prior, so that the stack can be compared
        with it as it is. Other candidates are not normalised; see :meth:`difference`.

        Raises:
            InvalidInputError: If "prior" is not among the candidates.
        """
        return self._difference(self.stack_scores - self.scores_of("prior"))

    def _difference(self, difference: Tensor) -> Difference:
        # Where both scores are minus infinity, neither candidate is better.
        difference = difference.nan_to_num(nan=0.0, posinf=torch.inf, neginf=-torch.inf)
        mean, low, high = interval_of_mean(difference, self.counts)
        n = self.effective_number
        if n < FEWEST_TO_RESAMPLE and math.isfinite(high - low):
            return Difference(mean=mean, low=low, high=high)
        data: tuple[Any, ...] = (difference.cpu().numpy(),)
        statistic: Any = np.mean
        if (counts := self.counts) is not None:
            data = tuple(
                values.cpu().numpy() for values in counts.of_groups(difference)
            )
            statistic = _weighted_mean
        with np.errstate(invalid="ignore"):  # of infinite means
            means = bootstrap(
                data,
                statistic,
                n_resamples=NUM_BOOTSTRAP,
                paired=len(data) > 1,
                method="percentile",
                rng=np.random.default_rng(0),
            ).bootstrap_distribution
        # SciPy's own interval interpolates between two means, of which one may be
        # infinite. These quantiles are always one of the means.
        tail = _expanded_tail(n)
        low, high = np.quantile(means, [tail, 1 - tail], method="inverted_cdf")
        return Difference(mean=mean, low=float(low), high=float(high))

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate: name, family, weight, scores, errors.

        The key "score" is the mean score with theta in its own units, and "score_z"
        that with theta in standard deviations of the prior. Both are in nats a pair.
        Their standard errors are the same, unless labels are partial.
        """
        rows = []
        weights = self.weights.weights.tolist()
        columns = self.log_scores.unbind(dim=1)
        for name, family, weight, scores in zip(
            self.names, self.families, weights, columns, strict=True
        ):
            score, error = self.mean_and_error(scores)
            score_z, error_z = self.mean_and_error(self.in_units_of_prior(scores))
            row = {"candidate": name, "family": family, "weight": weight}
            row |= {"score": score, "score_z": score_z}
            row |= {"standard_error": error, "standard_error_z": error_z}
            rows.append(row)
        return rows


def _weighted_mean(values: Any, weights: Any, axis: int = -1) -> Any:
    return (weights * values).sum(axis=axis) / weights.sum(axis=axis)


def _expanded_tail(n: float) -> float:
    """Return the tail of a percentile interval that is as wide as one of Student's t.

    The bootstrap's standard error lacks the factor of n / (n - 1), and percentiles do
    not know that it is an estimate.
    """
    n = max(n, 2.0)  # of weights of which one is far above the others
    return float(norm.sf((n / (n - 1)) ** 0.5 * student.ppf(0.975, n - 1)))


def fold_weights(
    log_scores: Tensor,
    fold: Tensor,
    *,
    pair_weights: Tensor | None = None,
) -> Tensor:
    """Return the weights fitted without each of the F folds, shape ``(F, K)``."""
    numbers: Sequence[int] = range(int(fold.max()) + 1)
    return torch.stack(
        [
            stacking_weights(
                log_scores[fold != number],
                pair_weights=(
                    None if pair_weights is None else pair_weights[fold != number]
                ),
            ).weights.to(log_scores)
            for number in numbers
        ]
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class LearningCurve:
    """The held-out score of the stack when it is trained on fewer pairs.

    Attributes:
        num_pairs: The numbers of pairs that the candidates were trained on, ascending.
        pair_scores: The log score of the stack at each of n held-out pairs, for each
            number of pairs, with theta in its own units, shape ``(P, n)``.
        pair_weights: How many pairs each held-out pair counts as, shape ``(n,)``; None
            if all count as one.
        groups: As in :class:`CrossValidation`.
    """

    num_pairs: tuple[int, ...]
    pair_scores: Tensor = field(repr=False)
    pair_weights: Tensor | None = field(default=None, repr=False)
    groups: Tensor | None = field(default=None, repr=False)

    @classmethod
    def of(cls, parts: Sequence[CrossValidation]) -> "LearningCurve":
        """Return the curve of cross-validations with increasing training sets."""
        return cls(
            num_pairs=tuple(part.num_trained_on for part in parts),
            pair_scores=torch.stack([part.stack_scores.double() for part in parts]),
            pair_weights=parts[0].pair_weights,
            groups=parts[0].groups,
        )

    @property
    def scores(self) -> tuple[float, ...]:
        """The mean held-out score at each number of pairs."""
        return tuple(mean for mean, _ in map(self._mean_and_error, self.pair_scores))

    @property
    def standard_errors(self) -> tuple[float, ...]:
        """The standard error of each mean score.

        All scores are means over the same pairs, so that their differences have smaller
        errors.
        """
        return tuple(error for _, error in map(self._mean_and_error, self.pair_scores))

    def gain(self, num_more: int) -> Difference:
        r"""Return how much more labels would add to the mean score, with an interval.

        The curve :math:`s_i(n) = a_i - b_i / n` is fitted to the scores of each
        held-out pair i. A stack of n labels is the average of posteriors that were
        each trained on N of them, as the last point was. With m more labels each is
        trained on N (n + m) / n, and the gain is

        .. math:: \bar b \left( \frac{1}{N} - \frac{n}{N (n + m)} \right) .

        The 95 % interval is that of Student's t for the mean slope :math:`\bar b`. It
        takes the pairs that were trained on as given, and the form of the curve as
        right.

        Args:
            num_more: m, the number of labels to add. If pairs belong to groups, such as
                recordings of one person, n and m are numbers of groups.

        Returns:
            The gain in nats a pair; NaN if the curve has a single point or a score is
            not finite.

        Raises:
            InvalidInputError: If the number is below 1.
        """
        check("num_more", num_more, Count)
        if len(self.num_pairs) < 2 or not torch.isfinite(self.pair_scores).all():
            return Difference(mean=float("nan"), low=float("nan"), high=float("nan"))
        inverse = torch.tensor(self.num_pairs).to(self.pair_scores).reciprocal()
        centred = inverse - inverse.mean()
        slopes = -(centred @ self.pair_scores) / centred.square().sum()
        last = self.num_pairs[-1]
        n = self.num_labels
        scale = 1 / last - n / (last * (n + num_more))
        mean, low, high = interval_of_mean(scale * slopes, self._counts)
        return Difference(mean=mean, low=low, high=high)

    @property
    def num_labels(self) -> int:
        """The number of pairs, or of their groups."""
        if self.groups is None:
            return self.pair_scores.shape[1]
        return len(self.groups.unique())

    @property
    def _counts(self) -> Counts | None:
        return counts_of(self.pair_weights, self.groups)

    def _mean_and_error(self, values: Tensor) -> tuple[float, float]:
        return mean_and_error(values, self._counts)
