"""What the report of a stack says, for its text and for its page."""

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from sbi_rope.data.parameters import is_improbable
from sbi_rope.density.sets import rank_needed
from sbi_rope.metrics.evaluation import FEWEST, LEVEL, verdict_of
from sbi_rope.metrics.statistics import Estimate

if TYPE_CHECKING:
    from sbi_rope.stacking.report import StackingReport

# A stack is called mostly one method if this has half of the weight.
MOSTLY = 0.5
# Sets of a higher level are not told apart from those that hold all draws.
ALL = 0.995
# How many more labels the learning curve is read for; and twice as many as there are.
FEW_MORE = 10
# A difference of less than this, in nats a pair, is slight: 10 % of the density.
SLIGHT = 0.1
# With a difference of so many nats, a network is far from anything that it has seen.
INCOMPARABLE = 1e6
# Weights below this, and so many entries of x, are not listed in the text.
SMALL_WEIGHT, MAX_ENTRIES = 0.005, 5

REFERENCES = {"prior": "the prior", "NPE": "NPE as it was"}
METHODS = {
    "prior": "the prior, which learns nothing from x",
    "NPE": "NPE as it was trained on simulations",
    "fine-tuned NPE": "NPE, trained further on the labels",
    "discrepancy": "NPE of simulations that a linear model of the discrepancy corrects",
    "discrepancy, fine-tuned": "NPE of corrected simulations, trained further on the "
    "labels",
    "regression": "the labels alone, without the simulator",
    "discrepancy, with x_o": "NPE of simulations that a linear model corrects, learned "
    "from observations without labels, too",
}


class Section(NamedTuple):
    """A question, and its answer: sentences, and whether each is alarming."""

    title: str
    lines: list[tuple[str, bool]]


def sections_of(
    report: "StackingReport", names: Sequence[str] | None = None
) -> list[Section]:
    """Return what a reader wants to know, in this order.

    Args:
        report: The report.
        names: A name for each parameter; those of the report if None.
    """
    return [
        Section("Did it help?", _help(report)),
        Section("May the intervals be trusted?", _trust(report, names)),
        Section("What is wrong with the simulator?", _simulator(report)),
        Section("Would more labels help?", _more_labels(report)),
    ]


def text_of(report: "StackingReport", sections: Sequence[Section]) -> str:
    """Return the printed report."""
    lines = [headline(report)]
    for title, sentences in sections:
        lines.append(f"\n{title}")
        for text, _ in sentences:
            lines += textwrap.wrap(
                text, 80, initial_indent="  ", subsequent_indent="    "
            )
    made = report.provenance
    if made:
        lines.append(
            f"\nMade in {made['seconds']} seconds with {made['simulator calls']} calls "
            "of the simulator."
        )
    return "\n".join(lines)


def headline(report: "StackingReport") -> str:
    """Say what was scored on what."""
    group = report.held_out.group
    groups = "" if group is None else f" in {len(group.unique())} groups"
    return (
        f"Stack of {len(report.names)} candidates, scored on {len(report)} hold-out "
        f"calibration pairs{groups}"
    )


def is_corrected(report: "StackingReport") -> bool:
    """Whether the correction for mass outside the prior changes the score."""
    comparable = report.held_out.mean(report.comparable_scores)
    return f"{report.held_out.lpp.mean:.2f}" != f"{comparable.mean:.2f}"


def _help(report: "StackingReport") -> list[tuple[str, bool]]:
    lines = [_compared(name, gain) for name, gain in report.gains.items()]
    held_out = report.held_out
    score, where = held_out.lpp, "with theta in its own units"
    if report.held_out.ranks.isnan().all():
        where = "relative to that of the prior"
    elif not math.isnan(held_out.lpp_z.mean):
        score, where = held_out.lpp_z, "with theta in standard deviations of the prior"
    lines.append(
        (f"The log density of the labels is {score:.2f} nats a pair {where}.", False)
    )
    if is_corrected(report):
        gain = held_out.lpp.mean - held_out.mean(report.comparable_scores).mean
        text = (
            f"{gain:.2f} nats of it come from the correction for mass outside the "
            "prior, which the difference from NPE leaves out."
        )
        lines.append((text, False))
    lines.append(_weights(report))
    if report.labels:
        text = f"Known were {report.labels}."
        if report.score_errors is not None:
            text += (
                " Scores and coverage are those of the labels, with their noise; the "
                f"Monte-Carlo error is {report.monte_carlo_error:.3f} nats."
            )
        lines.append((text, False))
    return lines


def _compared(name: str, gain: Estimate) -> tuple[str, bool]:
    """Say how the stack compares with a reference, no more than the interval shows."""
    other = REFERENCES[name]
    if abs(gain.mean) >= INCOMPARABLE:
        return f"{other} cannot be compared: its density there is arbitrary.", False
    if gain.low <= 0 <= gain.high:
        start = f"Not shown to differ from {other}"
    else:
        kind = "better" if gain.low > 0 else "worse"
        kind = f"slightly {kind}" if abs(gain.mean) < SLIGHT else kind
        start = f"{kind.capitalize()} than {other}"
    return f"{start}: {gain:+.2f} nats a pair (95% interval).", gain.high < 0


def _weights(report: "StackingReport") -> tuple[str, bool]:
    weights = report.family_weights
    listed = "; ".join(
        f"{family} {weight:.0%}{_how_many(report, family)}"
        for family, weight in weights.items()
        if weight >= SMALL_WEIGHT
    )
    family, weight = next(iter(weights.items()))
    if weight < MOSTLY:
        return f"No method has half of the weight: {listed}.", False
    text = f"Weights: {listed}."
    if family in METHODS:
        text += f" Mostly {METHODS[family]}."
    if family == "prior":
        text += " Check that rows of theta and x belong together."
    return text, family == "prior"


def _how_many(report: "StackingReport", family: str) -> str:
    count = report.families.count(family)
    return f" ({count} candidates)" if count > 1 else ""


def _trust(
    report: "StackingReport", names: Sequence[str] | None
) -> list[tuple[str, bool]]:
    held_out = report.held_out
    known = "labels" if report.score_errors is not None else "parameters"
    if held_out.ranks.isnan().all():
        return [("Coverage is not known for labels that are given as draws.", False)]
    lines = held_out.lines(known=known)
    if (
        verdict_of(held_out.acauc) == "over-confident"
        and held_out.num_independent >= FEWEST
    ):
        advice = "Collect more labels, or ask for intervals with `guaranteed=True`."
        lines.append((advice, True))
    wider = (
        f"These are scores of versions trained on {report.num_trained_on} pairs. Their "
        "average is deployed, which is usually a little wider.",
        False,
    )
    return [*lines, wider, *_prior(report), *_sets(report), _assumption(report)]


def _prior(report: "StackingReport") -> list[tuple[str, bool]]:
    """Say what follows if the parameters of the pairs do not follow the prior."""
    probability = report.probability_of_prior
    if not is_improbable(probability):
        return []
    text = (
        "The labels are not distributed like the prior (probability that they are: "
        f"{probability:.1g}). "
    )
    if len(report.keep_prior) == len(report.names):
        return [(f"{text}Scores and coverage hold for parameters like these.", True)]
    text += (
        "The stack expects the same of new observations. For others use "
        "`candidates=default_candidates(rope, learn_prior=False)`."
    )
    if (kept := report.score_of_prior_kept) is not None:
        text += (
            " The best candidate that keeps the prior is "
            f"{kept - report.held_out.mean(report.comparable_scores).mean:+.2f} nats "
            "from the stack here."
        )
    return [(text, True)]


def _sets(report: "StackingReport") -> list[tuple[str, bool]]:
    scores = report.set_scores
    if scores is None or rank_needed(LEVEL, len(scores)) > len(scores):
        return []
    needed = scores.level_needed(LEVEL)
    size = f"as large as the posterior's own {needed:.0%} sets"
    if needed > ALL:
        size = "larger than almost all draws"
    return [
        (
            f"{LEVEL:.0%} sets of all parameters together hold "
            f"{scores.share_held(LEVEL):.0%} of the exact labels; with a guarantee "
            f"(`guaranteed=True`) they are {size}.",
            False,
        )
    ]


def _assumption(report: "StackingReport") -> tuple[str, bool]:
    test, start = report.batch, "This holds for observations like those of the pairs"
    if test is None:
        return (
            f"{start}; `diagnose(rope, x_o, posterior=posterior)` tests others.",
            False,
        )
    if test.is_different:
        return (
            f"This need not hold for `x_o`, which differs from the pairs (p = "
            f"{test.p_value:.3f}); look at `diagnose(rope, x_o, posterior=posterior)`.",
            True,
        )
    return f"{start}; `x_o` is like them (p = {test.p_value:.2f}).", False


def _simulator(report: "StackingReport") -> list[tuple[str, bool]]:
    found = report.discrepancy
    if found is None:
        return [
            (
                "Not tested: x is no complete vector of at most 20 numbers, or no "
                "discrepancy model is in the stack. `DiscrepancyNPE.from_posterior(...)"
                ".report()` compares longer ones, and summaries of series and images.",
                False,
            )
        ]
    off = [one for one in found.summaries if one.is_off]
    notes = [(note, False) for note in found.notes]
    if not off:
        return [("No entry of x shows a discrepancy.", False), *notes]
    worst = "; ".join(
        f"{one.name} by {one.size.median:.2g} (shift {one.shift.median:.2g}, gain "
        f"{one.gain.median:.2g})"
        for one in off[:MAX_ENTRIES]
    )
    return [
        (
            f"{len(off)} of {len(found.summaries)} entries of x are off, in standard "
            f"deviations of simulations: {worst}"
            f"{'; and others' if len(off) > MAX_ENTRIES else ''}. Print "
            "`report.discrepancy` for intervals.",
            True,
        ),
        *notes,
    ]


def _more_labels(report: "StackingReport") -> list[tuple[str, bool]]:
    curve = report.learning_curve
    if curve is None:
        return [("Not tested: `stack(rope, learning_curve=True)` estimates it.", False)]
    points = ", ".join(
        f"{one.lpp.mean - curve.evaluations[0].lpp.mean:+.2f} nats with {n}"
        for n, one in zip(curve.num_pairs[1:], curve.evaluations[1:], strict=True)
    )
    start = f"Compared with training on {curve.num_pairs[0]} pairs"
    lines = [(f"{start}: {points or 'unknown'}.", False)]
    kind = "labels" if curve.evaluations[0].group is None else "groups"
    for more in dict.fromkeys((FEW_MORE, curve.num_labels)):
        gain = curve.gain(more)
        if math.isfinite(gain.mean):
            text = f"{more} more {kind} might add {gain:.2f} nats a pair, if the curve "
            text += "goes on like a - b / n."
            lines.append((text, False))
    return lines
