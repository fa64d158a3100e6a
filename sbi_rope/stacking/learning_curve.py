"""The learning curve of a stack: its held-out score against the number of pairs."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from sbi_rope.stacking.cross_validation import CrossValidation

__all__ = ["LearningCurve"]


@dataclass(frozen=True, kw_only=True)
class LearningCurve:
    """The held-out score of the stack when it is trained on fewer pairs.

    Attributes:
        num_pairs: The numbers of pairs that the candidates were trained on.
        scores: The mean held-out log score of the stack at each number, with theta in
            its own units.
        standard_errors: The standard error of each score. All scores are means over
            the same pairs, so that their differences have smaller errors.
    """

    num_pairs: tuple[int, ...]
    scores: tuple[float, ...]
    standard_errors: tuple[float, ...]

    @classmethod
    def of(cls, parts: Sequence[CrossValidation]) -> "LearningCurve":
        """Return the curve of cross-validations with increasing training sets."""
        scores = [part.stack_scores for part in parts]
        return cls(
            num_pairs=tuple(part.num_trained_on for part in parts),
            scores=tuple(float(s.mean()) for s in scores),
            standard_errors=tuple(float(s.std() / len(s) ** 0.5) for s in scores),
        )

    def gain_of_doubling(self) -> float:
        r"""Return how much twice as many pairs would add to the score, in nats.

        The curve :math:`s(n) = a - b / n` is fitted to all points and extrapolated. At
        the largest n the gain is :math:`b / (2 n)`, or 0 if the curve falls. It is NaN
        if there are fewer than two points or a score is not finite.
        """
        inverse = 1.0 / torch.tensor(self.num_pairs, dtype=torch.double)
        scores = torch.tensor(self.scores, dtype=torch.double)
        if len(scores) < 2 or not torch.isfinite(scores).all():
            return float("nan")
        centred = inverse - inverse.mean()
        slope = float((centred * scores).sum() / centred.square().sum())
        return max(0.0, -slope) / (2 * self.num_pairs[-1])
