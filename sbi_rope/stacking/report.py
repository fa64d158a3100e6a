"""The report of a stack: what out-of-fold scores say about it, in numbers and words."""

import math
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sbi_rope.data.parameters import is_improbable
from sbi_rope.density.sets import SetScores
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.evaluation import FEWEST, LEVEL
from sbi_rope.metrics.statistics import Estimate, TwoSampleTest
from sbi_rope.utils.settings import Count, check

# How many more labels the learning curve is read for; and twice as many as there are.
FEW_MORE = 10
# Smaller weights, and more entries of x, are not listed in the text.
SMALL_WEIGHT, MAX_ENTRIES = 0.015, 5

REFERENCES = {"prior": "the prior", "NPE": "NPE as it was"}
# A sentence, and whether it is alarming.
Line = tuple[str, bool]


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
    is deployed is the average of all versions, which is usually a little wider. Print
    the report for what it found.

    With labels that are not exact, scores are log densities of the labels, and ranks
    are those of the labels, NaN where a parameter was not measured. Scores of labels
    given as draws are relative to the prior, and their ranks are not known.

    Attributes:
        names: The names of the K candidates.
        weights: The weights of the candidates, fitted to all pairs, shape ``(K,)``.
        log_scores: The log density of the true parameters under each candidate, shape
            ``(n, K)``, not corrected for mass outside the prior.
        comparable_scores: That under the stack, not corrected either, shape ``(n,)``.
            For NPE on real data the correction may not end.
        fold: The fold of each pair, shape ``(n,)``.
        held_out: The scores of the stack at all pairs. Its density is normalised inside
            the support of the prior.
        set_scores: The scores that sets with a guarantee are made from; None if no
            label is exact.
        labels: What is known of labels that are not exact, or weighted, in words.
        are_exact: Whether all labels are exact.
        learning_curve: The learning curve of the stack, if it was asked for.
        batch: How ``x_o`` compares with the observations of the pairs; None without it,
            or with fewer than five of either.
        discrepancy: What the pairs say about each entry of x. None if no candidate has
            a discrepancy, or x is not a short vector.
        probability_of_prior: The probability that the parameters of the pairs were
            drawn from the prior, see :func:`~sbi_rope.discrepancy.learn_parameters`.
        keeps_prior: Whether no candidate learns from the pairs how parameters are
            distributed.
        provenance: How it was made, in words: seed, seconds, simulator calls.
    """

    names: tuple[str, ...]
    weights: Tensor
    log_scores: Tensor = field(repr=False)
    comparable_scores: Tensor = field(repr=False)
    fold: Tensor = field(repr=False)
    held_out: Evaluation
    set_scores: SetScores | None = field(default=None, repr=False)
    labels: str = ""
    are_exact: bool = True
    learning_curve: LearningCurve | None = None
    batch: TwoSampleTest | None = None
    discrepancy: DiscrepancyReport | None = None
    probability_of_prior: float | None = None
    keeps_prior: bool = False
    provenance: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def gains(self) -> dict[str, Estimate]:
        """How much higher the stack scores than the candidates "NPE" and "prior".

        Compared with the prior the stack is normalised, as it is deployed. Compared
        with NPE, which is not, it is not.
        """
        of_stack = {"NPE": self.comparable_scores, "prior": self.held_out.log_prob}
        columns = dict(zip(self.names, self.log_scores.unbind(dim=1), strict=True))
        gains = {}
        for name, scores in of_stack.items():
            if name in columns:
                gain = scores - columns[name]
                # Where both are minus infinity, neither is better.
                gains[name] = self.held_out.mean(gain.where(~gain.isnan(), 0.0))
        return gains

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate, the best out-of-fold score first.

        The key "score" is the LPP with theta in its own units, with the ends
        "score_low" and "score_high" of its interval, and "score_z" that with theta in
        standard deviations of the prior.
        """
        rows, held_out = [], self.held_out
        columns = self.weights.tolist(), self.log_scores.unbind(dim=1)
        for name, weight, scores in zip(self.names, *columns, strict=True):
            one, in_z = held_out.mean(scores), held_out.mean(scores + held_out.log_unit)
            row = {"candidate": name, "weight": weight, "score": one.mean}
            row |= {"score_low": one.low, "score_high": one.high, "score_z": in_z.mean}
            rows.append(row)
        return sorted(rows, key=lambda row: -row["score"])

    def __str__(self) -> str:
        lines = [headline(self)]
        for title, sentences in sections_of(self):
            lines.append(f"\n{title}")
            for text, _ in sentences:
                lines += textwrap.wrap(
                    text, 80, initial_indent="  ", subsequent_indent="    "
                )
        if made := self.provenance:
            lines.append(
                f"\nMade in {made['seconds']} seconds with {made['simulator calls']} "
                "calls of the simulator."
            )
        return "\n".join(lines)


# What it says, in text and on its page ------------------------------------------------


def headline(report: StackingReport) -> str:
    """Say what was scored on what."""
    group = report.held_out.group
    groups = "" if group is None else f" in {len(group.unique())} groups"
    return (
        f"Stack of {len(report.names)} candidates, scored on {len(report.fold)} "
        f"hold-out calibration pairs{groups}"
    )


def sections_of(report: StackingReport) -> list[tuple[str, list[Line]]]:
    """Return the questions of a reader, and the sentences that answer each."""
    return [
        ("Did it help?", [*_help(report)]),
        ("May the intervals be trusted?", [*_trust(report)]),
        ("What is wrong with the simulator?", [*_simulator(report)]),
        ("Would more labels help?", [*_more_labels(report)]),
    ]


def _help(report: StackingReport) -> Iterator[Line]:
    for name, gain in report.gains.items():
        yield _compared(REFERENCES[name], gain), gain.high < 0
    held_out = report.held_out
    score, where = held_out.lpp, "with theta in its own units"
    if held_out.ranks.isnan().all():
        where = "relative to that of the prior"
    elif not math.isnan(held_out.lpp_z.mean):
        score, where = held_out.lpp_z, "with theta in standard deviations of the prior"
    yield f"The log density of the labels is {score:.2f} nats a pair {where}.", False
    yield _weights(report)
    if report.labels:
        text = f"Known were {report.labels}."
        if not report.are_exact:
            text += " Scores and coverage are those of the labels, with their noise."
        yield text, False


def _compared(other: str, gain: Estimate) -> str:
    """Say how the stack compares with a reference, no more than the interval shows."""
    if not math.isfinite(gain.mean):
        return f"{other} cannot be compared: it has no density at some labels."
    start = f"{'Better' if gain.low > 0 else 'Worse'} than {other}"
    if gain.low <= 0 <= gain.high:
        start = f"Not shown to differ from {other}"
    return f"{start}: {gain:+.2f} nats a pair (95% interval)."


def _weights(report: StackingReport) -> Line:
    weights = dict(zip(report.names, report.weights.tolist(), strict=True))
    ordered = sorted(weights.items(), key=lambda item: -item[1])
    listed = [f"{name} {w:.0%}" for name, w in ordered if w >= SMALL_WEIGHT]
    text = f"Weights: {'; '.join(listed)}."
    if is_prior := weights.get("prior", 0.0) > 0.5:
        text += " Check that rows of theta and x belong together."
    return text, is_prior


def _trust(report: StackingReport) -> Iterator[Line]:
    held_out = report.held_out
    if held_out.ranks.isnan().all():
        yield "Coverage is not known for labels that are given as draws.", False
        return
    known = "parameters" if report.are_exact else "labels"
    yield from held_out.lines(known=known)
    if held_out.acauc.low > 0 and held_out.num_independent >= FEWEST:
        advice = "Collect more labels, or ask for intervals with `guaranteed=True`."
        yield advice, True
    if is_improbable(report.probability_of_prior):
        yield _prior(report), True
    if (scores := report.set_scores) is not None:
        text = f"{LEVEL:.0%} sets of all parameters together hold "
        yield f"{text}{scores.share_held(LEVEL):.0%} of the exact labels.", False
    yield _assumption(report.batch)


def _prior(report: StackingReport) -> str:
    """Say what follows if the parameters of the pairs do not follow the prior."""
    text = (
        "The labels are not distributed like the prior (probability that they are: "
        f"{report.probability_of_prior:.1g}). "
    )
    if report.keeps_prior:
        return f"{text}Scores and coverage hold for parameters like these."
    return (
        f"{text}The stack expects the same of new observations. For others use "
        "`candidates=default_candidates(rope, learn_prior=False)`."
    )


def _assumption(batch: TwoSampleTest | None) -> Line:
    start = "This holds for observations like those of the pairs"
    look = "`diagnose(rope, x_o, posterior=posterior)`"
    if batch is None:
        return f"{start}; {look} tests others.", False
    if not batch.is_different:
        return f"{start}; `x_o` is like them (p = {batch.p_value:.2f}).", False
    text = (
        "This need not hold for `x_o`, which differs from the pairs (p = "
        f"{batch.p_value:.3f}); look at {look}."
    )
    return text, True


def _simulator(report: StackingReport) -> Iterator[Line]:
    if (found := report.discrepancy) is None:
        text = (
            "Not tested: x is no complete vector of at most 20 numbers, or no "
            "discrepancy model is in the stack. `DiscrepancyNPE` compares longer ones."
        )
        yield text, False
        return
    if off := [one for one in found.summaries if one.is_off]:
        sizes = [f"{one.name} by {one.size.median:.2g}" for one in off[:MAX_ENTRIES]]
        text = (
            f"{len(off)} of {len(found.summaries)} entries of x are off, in standard "
            f"deviations of simulations: {'; '.join(sizes)}. Print "
            "`report.discrepancy` for shifts, gains and intervals."
        )
        yield text, True
    else:
        yield "No entry of x shows a discrepancy.", False
    if found.constant:
        yield f"The same in all simulations: {', '.join(found.constant)}.", False


def _more_labels(report: StackingReport) -> Iterator[Line]:
    if (curve := report.learning_curve) is None:
        yield "Not tested: `stack(rope, learning_curve=True)` estimates it.", False
        return
    (fewest, first), *others = zip(curve.num_pairs, curve.scores, strict=True)
    points = [f"{one.mean - first.mean:+.2f} nats with {n}" for n, one in others]
    text = f"Compared with training on {fewest} pairs: "
    yield f"{text}{', '.join(points) or 'unknown'}.", False
    kind = "labels" if curve.evaluations[0].group is None else "groups"
    for more in dict.fromkeys((FEW_MORE, curve.num_labels)):
        gain = curve.gain(more)
        if math.isfinite(gain.mean):
            text = f"{more} more {kind} might add {gain:.2f} nats a pair, if the curve "
            yield f"{text}goes on like a - b / n.", False
