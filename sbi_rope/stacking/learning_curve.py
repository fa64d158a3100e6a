"""The learning curve of a stack: its held-out score against the number of pairs."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sbi_rope._means import Counts, counts_of, interval_of_mean, mean_and_error
from sbi_rope.settings import Count, check
from sbi_rope.stacking.cross_validation import CrossValidation, Difference

__all__ = ["LearningCurve"]


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
