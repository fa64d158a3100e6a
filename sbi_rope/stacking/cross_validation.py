"""The weights of candidates by their held-out scores, and what follows from these."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from sbi_rope._statistics import interval_of_mean, mean_and_error
from sbi_rope.data import Counts
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.metrics import CoverageCurve
from sbi_rope.metrics.calibration import coverage_curve_of
from sbi_rope.sets.conformal import check_enough, rank_needed
from sbi_rope.settings import Count, NotNegative, Positive, check, one_of
from sbi_rope.tensors import as_batch, as_numbers

__all__ = [
    "CrossValidation",
    "Difference",
    "LearningCurve",
    "SetScores",
    "StackingWeights",
    "fold_weights",
    "stacking_weights",
]


@dataclass(frozen=True, eq=False, kw_only=True)
class StackingWeights:
    """The weights of candidates, and a bound on how far they are from the best.

    Attributes:
        weights: On the simplex, shape ``(K,)``, float64.
        score: The mean log score of the stack over the pairs that the weights were
            fitted to. It is too high for new pairs.
        gap: The objective, a sum over pairs, is at most this far below its maximum, in
            nats.
        num_iterations: The number of iterations of EM.
        converged: Whether the gap is at most the tolerance.
    """

    weights: Tensor
    score: float
    gap: float
    num_iterations: int
    converged: bool


def stacking_weights(
    log_scores: Tensor,
    *,
    pair_weights: Tensor | None = None,
    pseudo_count: float = 1.0,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
) -> StackingWeights:
    r"""Return the weights whose mixture of candidates scores best on held-out pairs.

    With the log score :math:`\ell_{ik}` of candidate k at pair i,

    .. math::
        \max_{w \in \Delta} \; \sum_{i=1}^{n} \log \sum_{k=1}^{K} w_k e^{\ell_{ik}}
        + \frac{c}{K} \sum_{k=1}^{K} \log w_k ,

    the mode under a Dirichlet prior with all parameters :math:`1 + c / K`. The prior
    counts as c pairs at which all candidates share the responsibility equally. With few
    pairs it prevents that a single candidate gets all the weight; with many pairs its
    effect vanishes. The problem is concave, and for c > 0 the solution is unique. EM
    starts from equal weights and repeats
    :math:`w_k \leftarrow (\sum_i r_{ik} + c / K) / (n + c)` with the responsibilities
    :math:`r_{ik} = w_k e^{\ell_{ik}} / \sum_m w_m e^{\ell_{im}}`.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        log_scores: :math:`\ell`, shape ``(n, K)``. Minus infinity is allowed, NaN and
            plus infinity are not. A pair that has minus infinity for all candidates is
            left out, with a warning.
        pair_weights: How many pairs each pair counts as, shape ``(n,)``: a factor of
            its term in the sum over i. One if None.
        pseudo_count: c, at least 0.
        tolerance: EM has converged when ``gap`` is at most this.
        max_iterations: EM stops after so many iterations, converged or not.

    Returns:
        The weights.

    Raises:
        InvalidInputError: If a shape does not fit, a score is NaN or plus infinity, or
            an argument is outside its range.

    Example:
        >>> log_scores = torch.tensor([[0.0, -9.0], [0.0, -9.0], [-9.0, 0.0]])
        >>> stacking_weights(log_scores, pseudo_count=0.0).weights.round(decimals=3)
        tensor([0.6670, 0.3330], dtype=torch.float64)
    """
    scores, of_pairs = _checked_scores(log_scores, pair_weights)
    check("pseudo_count", pseudo_count, NotNegative)
    check("tolerance", tolerance, Positive)
    check("max_iterations", max_iterations, Count)
    # Relative to the best candidate at each pair, so that exp does not over- or
    # underflow.
    density = (scores - scores.max(dim=1, keepdim=True).values).exp()
    num_candidates = density.shape[1]
    n = float(of_pairs.sum())
    share = pseudo_count / num_candidates
    weights = density.new_full((num_candidates,), 1.0 / num_candidates)
    gap, iteration = math.inf, 0
    for iteration in range(max_iterations + 1):
        # The derivative of the objective by the weight of each candidate.
        ratio = density / (density @ weights)[:, None]
        gradient = (ratio * of_pairs[:, None]).sum(dim=0)
        if share:
            gradient = gradient + share / weights
        # The objective is concave, so that it lies below its tangent everywhere.
        gap = float(gradient.max()) - (n + pseudo_count)
        if gap <= tolerance or iteration == max_iterations:
            break
        weights = weights * gradient
        weights = weights / weights.sum()
    mixed = torch.logsumexp(scores + weights.log(), dim=1)
    return StackingWeights(
        weights=weights,
        score=float((of_pairs * mixed).sum() / of_pairs.sum()),  # NaN of none
        gap=max(gap, 0.0),
        num_iterations=iteration,
        converged=gap <= tolerance,
    )


def _checked_scores(
    log_scores: Tensor, pair_weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the scores and weights of the pairs that a candidate does not exclude."""
    scores = as_numbers("log_scores", log_scores).double()
    if scores.ndim != 2 or not scores.shape[1]:
        raise InvalidInputError(
            f"Expected `log_scores` of shape (n, K); got {tuple(scores.shape)}."
        )
    if bool((scores.isnan() | scores.isposinf()).any()):
        raise InvalidInputError("Expected `log_scores` below infinity; got NaN or Inf.")
    of_pairs = scores.new_ones(len(scores))
    if pair_weights is not None:
        of_pairs = as_batch("pair_weights", pair_weights, (), rows=len(scores))
        if not bool((of_pairs > 0).all()):
            raise InvalidInputError(
                f"Expected positive `pair_weights`; got {float(of_pairs.min())}."
            )
    known = ~scores.isneginf().all(dim=1)
    if not known.all():
        warn_user(
            f"{int((~known).sum())} of {len(scores)} held-out pairs have density zero "
            "under every candidate and are left out of the weights. Add the prior as a "
            "candidate."
        )
    return scores[known], of_pairs.to(scores)[known]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A mean difference of log scores, pair by pair, and its 95 % interval.

    The interval is that of Student's t, over groups if pairs belong to groups. It has
    no ends if a difference is infinite.

    Attributes:
        mean: The mean over pairs.
        low: Lower end of the interval.
        high: Upper end.
    """

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, difference: Tensor, counts: Counts | None) -> "Difference":
        """Return the mean of the differences of all pairs, shape ``(n,)``."""
        # Where both scores are minus infinity, neither candidate is better.
        difference = difference.nan_to_num(nan=0.0, posinf=torch.inf, neginf=-torch.inf)
        mean, low, high = interval_of_mean(difference, counts)
        if torch.isinf(difference).any():
            low, high = -math.inf, math.inf
        return cls(mean=mean, low=low, high=high)


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
        counts: How many pairs each pair counts as, and which belong to one group, such
            as one person or specimen; None if all are independent and count as one.
            Pairs of a group share the weight of one. Errors and intervals are those of
            means of groups, because pairs of a group are not independent.
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
    counts: Counts | None = field(default=None, repr=False)
    score_errors: Tensor | None = field(default=None, repr=False)
    labels: str = ""
    set_scores: SetScores | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.fold)

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return int(self.fold.max()) + 1

    @property
    def groups(self) -> Tensor | None:
        """The number of the group of each pair; None if all are independent."""
        return None if self.counts is None else self.counts.groups

    @cached_property
    def weights(self) -> StackingWeights:
        """The weights of the candidates, fitted to all pairs."""
        weights = None if self.counts is None else self.counts.weights
        return stacking_weights(self.log_scores, pair_weights=weights)

    @property
    def effective_number(self) -> float:
        """The number of independent pairs of equal weight with the same precision."""
        if self.counts is None:
            return float(len(self))
        return self.counts.effective_number

    @property
    def monte_carlo_error(self) -> float:
        """The error of the mean stack score that comes from labels not being exact."""
        if self.score_errors is None:
            return 0.0
        weights = torch.ones_like(self.score_errors)
        if self.counts is not None:
            weights = self.counts.weights.to(weights)
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
        weights = fold_weights(self.log_scores, self.fold, self.counts)
        return torch.logsumexp(self.log_scores + weights[self.fold].log(), dim=1)

    @property
    def coverage(self) -> CoverageCurve:
        """Coverage of the stack's central intervals on held-out pairs."""
        return coverage_curve_of(self.levels, self.counts)

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
        return Difference.of(self.scores_of(name) - self.scores_of(other), self.counts)

    def gain_over_prior(self) -> Difference:
        """Return by how much the normalised stack scores higher than the prior.

        No density of the prior is outside the prior, so that the stack can be compared
        with it as it is. Other candidates are not normalised; see :meth:`difference`.

        Raises:
            InvalidInputError: If "prior" is not among the candidates.
        """
        return Difference.of(self.stack_scores - self.scores_of("prior"), self.counts)

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


def fold_weights(log_scores: Tensor, fold: Tensor, counts: Counts | None) -> Tensor:
    """Return the weights fitted without each of the F folds, shape ``(F, K)``."""
    without = [fold != number for number in range(int(fold.max()) + 1)]
    found = [
        stacking_weights(
            log_scores[rows],
            pair_weights=None if counts is None else counts.weights[rows],
        )
        for rows in without
    ]
    return torch.stack([one.weights for one in found]).to(log_scores)


@dataclass(frozen=True, eq=False, kw_only=True)
class LearningCurve:
    """The held-out score of the stack when it is trained on fewer pairs.

    Attributes:
        num_pairs: The numbers of pairs that the candidates were trained on, ascending.
        pair_scores: The log score of the stack at each of n held-out pairs, for each
            number of pairs, with theta in its own units, shape ``(P, n)``.
        counts: As in :class:`CrossValidation`.
    """

    num_pairs: tuple[int, ...]
    pair_scores: Tensor = field(repr=False)
    counts: Counts | None = field(default=None, repr=False)

    @classmethod
    def of(cls, parts: Sequence[CrossValidation]) -> "LearningCurve":
        """Return the curve of cross-validations with increasing training sets."""
        return cls(
            num_pairs=tuple(part.num_trained_on for part in parts),
            pair_scores=torch.stack([part.stack_scores.double() for part in parts]),
            counts=parts[0].counts,
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
        return Difference.of(scale * slopes, self.counts)

    @property
    def num_labels(self) -> int:
        """The number of pairs, or of their groups."""
        if self.counts is None or self.counts.groups is None:
            return self.pair_scores.shape[1]
        return len(self.counts.groups.unique())

    def _mean_and_error(self, values: Tensor) -> tuple[float, float]:
        return mean_and_error(values, self.counts)
