"""The report of a stack: whether calibration helped, and how well it is calibrated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_rope._validation import check_instance
from sbi_rope.metrics import (
    ACAUCScore,
    CoverageCurve,
    CoverageErrorScore,
    acauc_of,
    expected_coverage_error_of,
)
from sbi_rope.stacking.cross_validation import CrossValidation, Difference

__all__ = ["LearningCurve", "StackingReport"]

# The text says that a stack is mostly one method if this has half of the weight.
MOSTLY = 0.5
# The text states the coverage of intervals at this level.
LEVEL = 0.9

# The candidates that a stack is compared with, and how the text calls them.
REFERENCES = {"prior": "the prior", "NPE": "NPE as it was"}

IN_WORDS = {
    "prior": "your labels do not support anything sharper than the prior",
    "NPE": "the simulator serves these data as it is, and calibration changes little",
    "OT-only": "transport without tuning does the work, and labels add little to it",
    "tuning-only": "the tuned embedding is trusted without transport",
    "RoPE": "tuning and transport repair the simulator, as RoPE is meant to",
    "fine-tuned NPE": "the labels themselves train NPE for these data",
    "discrepancy": "a linear correction of the simulator predicts the labels best",
    "discrepancy, fine-tuned": "the corrected simulator is where the labels start from",
}


@dataclass(frozen=True, kw_only=True)
class LearningCurve:
    """The held-out score of the stack when it is trained on fewer pairs.

    Attributes:
        num_pairs: The numbers of pairs that the candidates were trained on.
        scores: The mean held-out log score of the stack at each number.
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
        score: Mean held-out log score of the stack's normalised density, and its
            standard error.
        comparable_score: The same without correction for leakage, so that it can be
            compared with the scores of the candidates.
        gains: How much higher the stack scores than the candidates "prior" and "NPE",
            by name, if these are among the candidates. None of the scores is corrected
            for leakage.
        family_weights: The weight of each method, summed over its settings, from the
            largest to the smallest.
        acauc: ACAUC of the stack's central intervals.
        coverage_error: Expected coverage error of the stack's central intervals.
        share_inside: Share of the parameters inside their 90 % intervals.
        num_simulator_calls: How many simulations the simulator made for this stack; 0
            if all were there already.
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
    num_simulator_calls: int = 0

    @classmethod
    def of(
        cls,
        cross_validation: CrossValidation,
        learning_curve: LearningCurve | None = None,
        *,
        num_simulator_calls: int = 0,
    ) -> "StackingReport":
        """Compute the report of a stack.

        Args:
            cross_validation: The scores of its candidates.
            learning_curve: The learning curve of the stack, if it was asked for.
            num_simulator_calls: How many simulations were made for it.
        """
        check_instance("cross_validation", cross_validation, CrossValidation)
        check_instance("learning_curve", learning_curve, LearningCurve, optional=True)
        scores, levels = cross_validation, cross_validation.levels
        return cls(
            cross_validation=scores,
            learning_curve=learning_curve,
            score=_mean_and_error(scores.stack_scores),
            comparable_score=_mean_and_error(scores.scores_of("stack")),
            gains={
                name: scores.difference("stack", name)
                for name in REFERENCES
                if name in scores.names
            },
            family_weights=_family_weights(scores),
            acauc=acauc_of(levels),
            coverage_error=expected_coverage_error_of(levels),
            share_inside=float((levels <= LEVEL).double().mean()),
            num_simulator_calls=num_simulator_calls,
        )

    @property
    def levels(self) -> Tensor:
        """The levels of held-out pairs, see :class:`CrossValidation`."""
        return self.cross_validation.levels

    @property
    def coverage(self) -> CoverageCurve:
        """Coverage of the stack's central intervals on held-out pairs."""
        return self.cross_validation.coverage

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate, the best held-out score first."""
        rows = self.cross_validation.as_rows()
        return sorted(rows, key=lambda row: -row["score"])

    def to_dataframe(self) -> Any:
        """Return :meth:`as_rows` as a pandas table.

        Raises:
            ImportError: If pandas is not installed.
        """
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise ImportError(
                "pandas is not installed. Run `pip install pandas`, or use `as_rows()`."
            ) from error
        return pandas.DataFrame(self.as_rows())

    def __str__(self) -> str:
        n = len(self.cross_validation)
        score, error = self.score
        lines = [
            f"Stack of {len(self.cross_validation.names)} candidates, scored on {n} "
            "held-out calibration pairs",
            f"  log score of the stack: {score:.2f} +- {error:.2f} a pair",
            *self._gains(),
            *self._weights(),
            *self._calibration(),
            *self._more_labels(),
            *self._simulator_calls(),
        ]
        return "\n".join(lines)

    def _gains(self) -> list[str]:
        lines = []
        for name, gain in self.gains.items():
            if gain.low > 0:
                verdict = f"better than {REFERENCES[name]}"
            elif gain.high < 0:
                verdict = f"WORSE than {REFERENCES[name]}"
            else:
                verdict = f"not shown to differ from {REFERENCES[name]}"
            lines.append(
                f"  {verdict}: {gain.mean:+.2f} nats a pair, 95 % interval "
                f"{gain.low:+.2f} to {gain.high:+.2f}"
            )
        return lines

    def _weights(self) -> list[str]:
        (family, weight), *_ = self.family_weights.items()
        shares = ", ".join(
            f"{name} {share:.0%}" for name, share in self.family_weights.items()
        )
        if weight < MOSTLY:
            return [f"  no method has half of the weight: {shares}"]
        line = f"  mostly {family}"
        if family in IN_WORDS:
            line += f": {IN_WORDS[family]}"
        return [line, f"  weights: {shares}"]

    def _calibration(self) -> list[str]:
        acauc, error = self.acauc, self.coverage_error
        if abs(acauc.value) <= 2 * acauc.standard_error:
            verdict = "calibrated as far as these pairs can tell"
        else:
            verdict = "over-confident" if acauc.value > 0 else "under-confident"
        return [
            f"  {verdict}: ACAUC {acauc.value:+.3f} +- {acauc.standard_error:.3f}, "
            f"coverage error {error.value:.3f}; {LEVEL:.0%} intervals hold "
            f"{self.share_inside:.0%} of the parameters"
        ]

    def _more_labels(self) -> list[str]:
        curve = self.learning_curve
        if curve is None:
            return []
        points = ", ".join(
            f"{n}: {score:.2f}"
            for n, score in zip(curve.num_pairs, curve.scores, strict=True)
        )
        lines = [f"  score when trained on so many pairs: {points}"]
        gain = curve.gain_of_doubling()
        if math.isfinite(gain):
            lines.append(f"  twice as many labels might add {gain:.2f} nats")
        return lines

    def _simulator_calls(self) -> list[str]:
        if not self.num_simulator_calls:
            return []
        return [f"  simulator calls: {self.num_simulator_calls:,}"]


def _mean_and_error(scores: Tensor) -> tuple[float, float]:
    return float(scores.mean()), float(scores.std() / len(scores) ** 0.5)


def _family_weights(scores: CrossValidation) -> dict[str, float]:
    totals: dict[str, float] = {}
    weights = scores.weights.weights.tolist()
    for family, weight in zip(scores.families, weights, strict=True):
        totals[family] = totals.get(family, 0.0) + weight
    return dict(sorted(totals.items(), key=lambda item: -item[1]))
