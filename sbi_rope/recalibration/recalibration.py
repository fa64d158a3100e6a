"""Recalibrate posteriors by pairs that they have not seen."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sbi_rope._means import Counts, counts_of, interval_of_mean, mean_and_error
from sbi_rope._random import seeded
from sbi_rope.metrics.calibration import (
    ACAUC_IN_WORDS,
    ACAUCScore,
    acauc_of_pairs,
)
from sbi_rope.recalibration.factors import HeldOutGrid, HeldOutMixture

__all__ = ["Recalibration", "recalibrate"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Recalibration:
    """By which factors a posterior was made narrower or wider, and what it gained.

    The pairs of a fold are scored with factors that the other folds chose, among
    factors of one parameter around the common factor of all pairs.

    Attributes:
        factors: By how much the distance from the centre is multiplied, for each
            parameter, shape ``(d,)``; all 1 if they are not used.
        gain: By how much the factors raised the mean log score of held-out pairs.
        interval: The 95 % interval of ``gain``.
        is_used: Whether the factors are used. They are if they raised the score by more
            than its standard error, so that a posterior is left as it is in doubt.
        levels_before: The levels of the central intervals that end at the true
            parameters without the factors, shape ``(n, d)``.
        levels_after: The same with the factors of the other folds.
        pair_weights: How many pairs each pair counts as, shape ``(n,)``.
        groups: A number for each pair, the same for pairs of one person or specimen,
            shape ``(n,)``; None if all differ.
    """

    factors: Tensor
    gain: float
    interval: tuple[float, float]
    is_used: bool
    levels_before: Tensor = field(repr=False)
    levels_after: Tensor = field(repr=False)
    pair_weights: Tensor | None = field(default=None, repr=False)
    groups: Tensor | None = field(default=None, repr=False)

    @property
    def before(self) -> ACAUCScore:
        """The calibration of held-out pairs without the factors."""
        return acauc_of_pairs(self.levels_before, self._counts)

    @property
    def after(self) -> ACAUCScore:
        """The calibration of held-out pairs with the factors."""
        return acauc_of_pairs(self.levels_after, self._counts)

    @property
    def _counts(self) -> Counts | None:
        return counts_of(self.pair_weights, self.groups)

    def __str__(self) -> str:
        low, high = self.interval
        gain = f"{self.gain:+.2f} nats a held-out pair ({low:+.2f} to {high:+.2f})"
        if not self.is_used:
            return (
                f"Recalibration was not used: its gain, {gain}, is not more than its "
                "standard error."
            )
        factors = ", ".join(f"{factor:.2f}" for factor in self.factors.tolist())
        return (
            f"Recalibration multiplies the spread of the parameters by {factors}: "
            f"{gain}, ACAUC {self.before.value:+.3f} before and "
            f"{self.after.value:+.3f} after ({ACAUC_IN_WORDS})."
        )


@torch.no_grad()
def recalibrate(
    folds: Sequence[HeldOutMixture], counts: Counts, *, seed: int
) -> Recalibration:
    """Choose factors for the spread of posteriors by the scores of held-out pairs.

    Args:
        folds: The mixture of each fold, with the pairs of the fold. There are at least
            two, so that the pairs of each can be scored with factors of the others.
        counts: How many pairs each pair counts as, in the order of the folds.
        seed: Seed of the draws.
    """
    weights = counts.weights
    with seeded(seed):
        grid = HeldOutGrid.of(folds, weights)
    numbers = torch.cat(
        [torch.full((len(fold.theta),), k) for k, fold in enumerate(folds)]
    ).to(weights.device)
    scores = torch.empty_like(grid.unchanged)
    before, after = [], []
    for k, fold in enumerate(folds):
        rows = numbers == k
        choice = grid.best(~rows)
        # With all factors together, whose effects do not add up if parameters are
        # correlated.
        together = fold.log_prob(choice.factors.to(fold.theta.device)[None])[:, 0]
        scores[rows] = together.where(grid.says_something[rows], 0.0)
        with seeded(seed):
            before.append(fold.levels(torch.ones_like(choice.factors)))
            after.append(fold.levels(choice.factors))
    gains = scores - grid.unchanged
    gain, low, high = interval_of_mean(gains, counts)
    is_used = gain > mean_and_error(gains, counts)[1]
    factors = grid.best(torch.ones_like(weights, dtype=torch.bool)).factors
    return Recalibration(
        factors=factors if is_used else torch.ones_like(factors),
        gain=gain,
        interval=(low, high),
        is_used=is_used,
        levels_before=torch.cat(before),
        levels_after=torch.cat(after),
        pair_weights=weights,
        groups=counts.groups,
    )
