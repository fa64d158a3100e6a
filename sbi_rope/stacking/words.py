"""What a printed report of a stack says, and how candidates are called in words."""

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from sbi_rope.discrepancy.parameters import is_improbable
from sbi_rope.metrics.by_estimate import in_words
from sbi_rope.metrics.calibration import ACAUC_IN_WORDS, FEWEST
from sbi_rope.settings import default_names
from sbi_rope.stacking.cross_validation import Difference, LearningCurve

if TYPE_CHECKING:
    from sbi_rope.stacking.report import StackingReport

__all__ = [
    "IF_MOSTLY_PRIOR",
    "IN_WORDS",
    "LEVEL",
    "MOSTLY",
    "NOT_CHECKED",
    "OVER_CONFIDENT",
    "REFERENCES",
    "TOO_FEW",
    "are_relative",
    "compared",
    "coverage_by_estimate",
    "depends_on_estimate",
    "differs",
    "gains_of",
    "is_comparable",
    "lines_of",
    "not_the_prior",
    "parameters_off",
    "sets_held",
]

# Of labels that are given as draws.
NOT_CHECKED = "coverage is not known for labels that are given as draws"
TOO_FEW = "too few pairs to say what it means"
# The text says that a stack is mostly one method if this has half of the weight.
MOSTLY = 0.5
# The share of parameters inside intervals is stated at this level.
LEVEL = 0.9
# Sets of a higher level are not told apart from those that hold all draws.
ALL = 0.995
# The text says what so many more labels would add, and what twice as many would.
FEW_MORE = 10
# A difference of less than this, in nats a pair, is called slight: 10 % of the density.
SLIGHT = 0.1
# Where a density is this many nats lower, its network is far from anything it has seen.
INCOMPARABLE = 1e6

# The candidates that a stack is compared with, and how the text calls them.
REFERENCES = {"prior": "the prior", "NPE": "NPE as it was"}

# What a verdict on all parameters says if it does not hold for each of them.
ON_AVERAGE = ", on average over the parameters,"
# What to do about a stack whose intervals are too narrow.
OVER_CONFIDENT = (
    "More labels help most. Until then, take intervals of a higher level than you need."
)

# What to do if they are too narrow for some estimates and too wide for others.
IF_IT_DEPENDS = (
    "Expect an interval to hold as often as the share of its third says, and label "
    "more observations there. A guarantee is about all observations together, and does "
    "not change this."
)

# What follows if the parameters of the pairs do not follow the prior.
IF_LEARNED = (
    "The stack expects the same of new observations, and is too sure about others."
)
IF_KEPT = (
    "The stack keeps the prior. It may look too wide for such parameters, and its "
    "scores, its calibration and its sets with a guarantee hold for these only."
)

IF_MOSTLY_PRIOR = "Check that theta and x of the pairs belong together, row by row"
# What each method is. Whether it is better than others is for the scores to say.
IN_WORDS = {
    "prior": "the prior, which learns nothing from x",
    "NPE": "NPE as it was trained on simulations",
    "fine-tuned NPE": "the labels train NPE further",
    "discrepancy": "NPE of simulations that a linear model, learnt from the labels, "
    "has corrected",
    "discrepancy, fine-tuned": "NPE of simulations that a linear model has corrected, "
    "trained further by the labels",
    "regression": "the labels alone, without the simulator",
    "discrepancy, with x_o": "NPE of simulations that a linear model has corrected, "
    "learnt from the labels and from observations without",
}


def compared(gain: Difference, name: str) -> str:
    """Say how the stack compares with a reference, no more than the interval shows."""
    if not is_comparable(gain):
        return f"not comparable with {REFERENCES[name]}, whose density is arbitrary"
    if gain.low <= 0 <= gain.high:
        return f"not shown to differ from {REFERENCES[name]}"
    slightly = "slightly " if abs(gain.mean) < SLIGHT else ""
    return f"{slightly}{'better' if gain.low > 0 else 'worse'} than {REFERENCES[name]}"


def is_comparable(gain: Difference) -> bool:
    """Tell whether a reference was asked about what it has seen the like of."""
    return abs(gain.mean) < INCOMPARABLE


def differs(report: "StackingReport") -> bool:
    """Tell whether the correction for mass outside the prior changes the score."""
    return f"{report.score[0]:.2f}" != f"{report.comparable_score[0]:.2f}"


def lines_of(report: "StackingReport") -> list[str]:
    """Return the lines of a printed report."""
    scores = report.cross_validation
    n, several = len(scores), ""
    if scores.groups is not None:
        number = len(scores.groups.unique())
        several = f" in {number} groups, each of which counts once"
    return [
        f"Stack of {len(scores.names)} candidates, scored on {n} "
        f"held-out calibration pairs{several}",
        *_labels(report),
        *_scores(report),
        *_gains(report),
        *_weights(report),
        *_parameters(report),
        *_calibration(report),
        *_more_labels(report),
        *_what_it_took(report),
    ]


def _labels(report: "StackingReport") -> list[str]:
    scores = report.cross_validation
    if not scores.labels:
        return []
    lines = [f"  {scores.labels}"]
    if scores.score_errors is not None:
        lines += [
            "    scores are relative to those of the prior at the draws"
            if are_relative(report)
            else "    scores and coverage are those of the measured values, with any "
            "noise of their labels",
            f"    Monte-Carlo error of the score: {scores.monte_carlo_error:.3f} nats",
        ]
    return lines


def _scores(report: "StackingReport") -> list[str]:
    lines = [
        "  log score, in nats a pair (higher is better), of models trained without it;",
        "  their average is deployed, usually a little better and wider:",
    ]
    scores = {
        "with theta in its own units": report.score,
        "with theta in standard deviations of the prior": report.score_z,
    }
    unit = " (own units)"
    if are_relative(report):
        scores, unit = {"above the prior": report.score}, ""
    for kind, (score, error) in scores.items():
        if not math.isnan(score):
            lines.append(f"    {score:.2f} +- {error:.2f} {kind}")
    if differs(report):
        lines += [
            f"    {report.comparable_score[0]:.2f} before correction for mass outside "
            f"the prior{unit}; NPE is not",
            "    corrected, so that a difference from NPE starts from this number",
        ]
    return lines


def is_measured(report: "StackingReport") -> bool:
    """Whether coverage is that of measured values, and not of the parameters."""
    return report.cross_validation.score_errors is not None


def are_relative(report: "StackingReport") -> bool:
    """Whether labels are given as draws, which have no levels and no density."""
    return bool(torch.isnan(report.levels).all())


def _gains(report: "StackingReport") -> list[str]:
    lines = []
    for name, gain in report.gains.items():
        line = f"  {compared(gain, name)}"
        if is_comparable(gain):
            line += f": {gain.mean:+.2f} nats a pair in any unit, "
            line += f"95 % interval {gain.low:+.2f} to {gain.high:+.2f}"
        lines.append(line)
    return lines


def _weights(report: "StackingReport") -> list[str]:
    (family, weight), *_ = report.family_weights.items()
    shares = ", ".join(
        f"{name} {share:.0%}{_how_many(report, name)}"
        for name, share in report.family_weights.items()
    )
    if weight < MOSTLY:
        return [f"  no method has half of the weight: {shares}"]
    line = f"  mostly {family}"
    if family in IN_WORDS:
        line += f": {IN_WORDS[family]}"
    if family == "prior":
        line += f". {IF_MOSTLY_PRIOR}"
    return [line, f"  weights: {shares}"]


def _how_many(report: "StackingReport", family: str) -> str:
    count = report.cross_validation.families.count(family)
    return f" ({count} candidates)" if count > 1 else ""


def not_the_prior(report: "StackingReport") -> str:
    """Say what follows if the pairs do not follow the prior; nothing if they may."""
    if not is_improbable(report.probability_of_prior):
        return ""
    return IF_LEARNED if report.learns_prior else IF_KEPT


def _parameters(report: "StackingReport") -> list[str]:
    what_follows = not_the_prior(report)
    if not what_follows:
        return []
    line = (
        "the parameters of the pairs are not distributed like the prior (probability "
        f"that they are: {report.probability_of_prior:.1g}). {what_follows}"
    )
    if report.learns_prior:
        line += (
            " For others use `candidates=default_candidates(rope, learn_prior=False)`."
        )
        if (kept := report.score_of_prior_kept) is not None:
            line += f" The best candidate that keeps the prior scores {kept:.2f} here."
    return _wrapped([line], indent=2)


def _wrapped(lines: Sequence[str], *, indent: int) -> list[str]:
    """Break sentences into lines of the report."""
    first, others = " " * indent, " " * (indent + 2)
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            line, 88, initial_indent=first, subsequent_indent=others
        )
    ]


def _calibration(report: "StackingReport") -> list[str]:
    n = report.cross_validation.effective_number
    acauc, (low, high) = report.acauc, report.acauc.interval
    verdict = acauc.verdict
    if verdict == "unknown":
        return [f"  {NOT_CHECKED}"]
    if n < FEWEST:
        return [f"  ACAUC {acauc.value:+.3f}, of {TOO_FEW}"]
    error = report.coverage_error
    beside = ""
    if not math.isnan(error.if_calibrated):
        expected = f"{error.if_calibrated:.3f} with {n:.0f} pairs"
        beside = f"; a calibrated posterior has about {expected}"
    advice = [f"    {OVER_CONFIDENT}"] if verdict == "over-confident" else []
    off = parameters_off(report)
    if verdict == "calibrated":
        verdict += f"{ON_AVERAGE if off else ''} as far as these pairs can tell"
    else:
        verdict += " on held-out pairs"
    return [
        f"  {verdict}: ACAUC {acauc.value:+.3f}, 95 % interval {low:+.3f} to "
        f"{high:+.3f}",
        f"    ({ACAUC_IN_WORDS})",
        f"    coverage error {error.value:.3f}{beside}",
        f"    {LEVEL:.0%} intervals hold {report.share_inside:.0%} of the "
        f"{'measured values' if is_measured(report) else 'parameters'}",
        *(f"    {line}" for line in off),
        *advice,
        *_by_estimate(report),
        *_sets(report),
        *_assumption(report),
    ]


def parameters_off(
    report: "StackingReport", names: Sequence[str] | None = None
) -> list[str]:
    """Say which parameters are not calibrated by themselves.

    It says nothing about a single parameter, whose verdict is that of the stack.
    """
    scores = report.acauc_of_parameters
    names = names or report.parameter_names or default_names(len(scores))
    few = report.cross_validation.effective_number < FEWEST
    unknown = report.acauc.verdict == "unknown"  # that of labels given as draws
    if few or unknown or len(scores) < 2:
        return []
    lines = []
    for name, score in zip(names, scores, strict=True):
        if score.verdict == "unknown":
            lines.append(f"{name} was not measured, so that its width is not checked")
        elif score.verdict != "calibrated":
            low, high = score.interval
            lines.append(
                f"{name} by itself is {score.verdict}: ACAUC {score.value:+.3f}, "
                f"{100 - 5 / len(scores):.3g} % interval {low:+.3f} to {high:+.3f}"
            )
    return lines


def depends_on_estimate(report: "StackingReport") -> bool:
    """Whether the coverage of a parameter depends on its estimate, as far as known."""
    return any(report.by_estimate.depends)


def coverage_by_estimate(
    report: "StackingReport", names: Sequence[str] | None = None
) -> list[str]:
    """Say for which parameters the coverage depends on the estimate, or for none."""
    found = report.by_estimate
    names = names or report.parameter_names or default_names(len(found.p_values))
    known = "measured values" if is_measured(report) else "parameters"
    return in_words(found, names, known=known)


def _by_estimate(report: "StackingReport") -> list[str]:
    lines = coverage_by_estimate(report)
    if depends_on_estimate(report):
        lines.append(IF_IT_DEPENDS)
    return _wrapped(lines, indent=4)


def _sets(report: "StackingReport") -> list[str]:
    held = sets_held(report)
    if held is None:
        return []
    share, size = held
    of = "pairs with exact labels" if is_measured(report) else "pairs"
    return [
        f"    {LEVEL:.0%} sets of all parameters hold {share:.0%} of the {of}; with a "
        "guarantee,",
        f"    `posterior.credible_set({LEVEL}, x, guaranteed=True)`, they are {size}",
    ]


def sets_held(report: "StackingReport") -> tuple[float, str] | None:
    """Return the share of pairs in their sets, and the size of those with a guarantee.

    It is None if there are too few pairs for a guarantee at :data:`LEVEL`.
    """
    if report.joint_sets is None:
        return None
    share, needed = report.joint_sets
    size = f"about as large as {needed:.0%} sets"
    if needed > ALL:
        size = "larger than what almost all draws of the stack fill"
    return share, size


def _assumption(report: "StackingReport") -> list[str]:
    test = report.batch
    if test is None:
        return [
            "    this holds for observations like those of the pairs; "
            "`diagnose(rope, x_o)` tests whether a batch is like them"
        ]
    if test.is_different:
        return [
            "    this need NOT hold for the batch, which differs from the pairs "
            f"(p = {test.p_value:.3f}):",
            "    look at `diagnose(rope, x_o)`",
        ]
    return [
        "    this holds for observations like those of the pairs; the batch shows "
        f"no sign of a difference (p = {test.p_value:.2f})"
    ]


def _more_labels(report: "StackingReport") -> list[str]:
    curve = report.learning_curve
    if curve is None:
        return []
    points = ", ".join(
        f"{n} pairs: {score:.2f}"
        for n, score in zip(curve.num_pairs, curve.scores, strict=True)
    )
    lines = [f"  log score by training pairs, theta in its own units: {points}"]
    return [*lines, *(f"  {line}" for line in gains_of(curve))]


def gains_of(curve: LearningCurve) -> list[str]:
    """Say what a few more labels would add, and what twice as many would."""
    gains = {
        more: curve.gain(more) for more in dict.fromkeys((FEW_MORE, curve.num_labels))
    }
    size = curve.pair_scores.shape[1] / curve.num_labels
    kind = "labels" if size == 1 else f"groups of {size:.3g} pairs"
    lines = [
        f"{more} more {kind} might add {gain.mean:.2f} nats a pair (95 % interval "
        f"{gain.low:.2f} to {gain.high:.2f})"
        for more, gain in gains.items()
        if math.isfinite(gain.mean)
    ]
    return [*lines, "if the curve goes on like a - b / n"] if lines else []


def _what_it_took(report: "StackingReport") -> list[str]:
    made = report.provenance
    if not made:
        return []
    lines = [
        f"made in {made['seconds']} seconds with {made['simulator calls']} calls of "
        f"the simulator; longest: {made['longest']}"
    ]
    if "left out" in made:
        lines.append(f"left out: {made['left out']}")
    return _wrapped(lines, indent=2)
