"""Sections of a page about calibration, discrepancies and a diagnosis."""

import math
from collections.abc import Sequence

from sbi_rope.diagnosis import Diagnosis, Finding
from sbi_rope.diagnosis.report import (
    IN_BRIEF,
    OF_OTHERS,
    whom_it_concerns,
    why_expected,
)
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.metrics import CoverageCurve
from sbi_rope.metrics.calibration import (
    acauc_of,
    coverage_curve_of,
)
from sbi_rope.plots import (
    calibration_curves,
    discrepancy,
    implied_parameters,
    ranks_by_estimate,
)
from sbi_rope.reports.page import (
    finding,
    number,
    paragraph,
    percent,
    picture,
    section,
    table,
)
from sbi_rope.stacking import StackingReport
from sbi_rope.stacking.words import (
    IF_IT_DEPENDS,
    LEVEL,
    depends_on_estimate,
    is_measured,
    sets_held,
)

__all__ = [
    "calibration_section",
    "diagnosis_section",
    "discrepancy_section",
    "no_discrepancy_section",
]

# With more parameters their curves cannot be told apart.
MAX_CURVES = 5


def calibration_section(report: StackingReport, names: Sequence[str]) -> str:
    """Return what held-out pairs say about the intervals of each parameter."""
    levels, curve = report.levels, report.coverage
    counts, error = report.cross_validation.counts, report.coverage_error
    rows = [_row("all parameters", report.acauc.value, report.acauc.interval, curve)]
    curves = {"all parameters": curve}
    for k, name in enumerate(names):
        score = acauc_of(levels[:, [k]], counts)
        if score.verdict == "unknown":  # it was never measured
            continue
        own = coverage_curve_of(levels[:, [k]], counts)
        if len(names) > 1:
            rows.append(_row(name, score.value, score.interval, own))
            curves[name] = own
    if len(names) > MAX_CURVES:
        curves = {"all parameters": curve}
    n, drawn = report.cross_validation.effective_number, calibration_curves(curves)
    drawn.set_size_inches(5.8, 3.4)  # so that its text can be read on a narrow screen
    return section(
        "Are the uncertainties right?",
        table(
            (
                "parameter",
                "in 50 % intervals",
                "in 90 % intervals",
                "ACAUC",
                "95 % interval",
            ),
            rows,
            numbers=(1, 2, 3, 4),
            strong=(0,),
        ),
        paragraph(
            "ACAUC: 0 is calibrated, positive is over-confident, negative is too wide. "
            "There is a sign of either only if the interval leaves 0 out; among many "
            f"parameters, one in twenty does so by chance. The coverage error is "
            f"{number(error.value, digits=3)}; a calibrated posterior has about "
            f"{number(error.if_calibrated, digits=3)} with {n:.0f} pairs.",
            kind="note",
        ),
        *_sets(report),
        picture(
            drawn,
            caption="The share of known parameters inside intervals of each level. "
            "Below the diagonal intervals are too narrow, above it too wide. At "
            "each level the band holds 95 % of the curves of calibrated posteriors.",
        ),
        *_by_estimate(report, names),
    )


def _by_estimate(report: StackingReport, names: Sequence[str]) -> list[str]:
    """Return whether coverage is the same for low and for high estimates."""
    found = report.by_estimate
    if not found.num_tested:
        return []
    inside, rows, alarming = percent(found.level), [], []
    for name, shares, p_value, depends in zip(
        names, found.shares.tolist(), found.p_values, found.depends, strict=True
    ):
        if math.isnan(p_value):
            continue
        if depends:
            alarming.append(len(rows))
        rows.append((name, *map(percent, shares), number(p_value, digits=3)))
    depends = depends_on_estimate(report)
    verdict = "There is no sign of it here."
    if depends:
        verdict = "Here it depends on the estimate."
    text = (
        "Coverage can be right on average and wrong for low or high estimates. "
        f"{verdict} The table has the share of known parameters inside their {inside} "
        "intervals for each third of the estimates, and the p-value of a test of "
        "whether intervals are equally good everywhere."
    )
    return [
        paragraph(f"{text} {IF_IT_DEPENDS}" if depends else text),
        table(
            ("parameter", "lowest third", "middle third", "highest third", "p"),
            rows,
            numbers=(1, 2, 3, 4),
            alarming=alarming,
        ),
        picture(
            ranks_by_estimate(found, parameter_names=names),
            caption="Where each known parameter is among samples of its posterior, "
            "from 0 (below all) to 1 (above all), against the estimate. For a "
            "calibrated posterior the points are spread evenly everywhere. Those in "
            f"the grey bands are outside their {inside} intervals, and the numbers "
            "above are the shares inside.",
            wide=len(names) > 2,
        ),
    ]


def _sets(report: StackingReport) -> list[str]:
    held = sets_held(report)
    if held is None:
        return []
    share, size = held
    of = "the measurements"
    if is_measured(report):
        of += " whose parameters are known exactly"
    return [
        paragraph(
            f"{percent(LEVEL)} sets of all parameters together held those of "
            f"{percent(share)} of {of}. Sets that are guaranteed to hold about "
            f"{percent(LEVEL)} are {size}.",
            kind="note",
        )
    ]


def _row(
    name: str, value: float, interval: tuple[float, float], curve: CoverageCurve
) -> tuple[str, ...]:
    low, high = (number(end, sign=True, digits=3) for end in interval)
    half, most = (percent(float(curve.average[level - 1])) for level in (50, 90))
    return name, half, most, number(value, sign=True, digits=3), f"{low} to {high}"


def discrepancy_section(report: DiscrepancyReport) -> str:
    """Return how each entry of x differs between reality and simulations."""
    rows = [
        (
            summary.name,
            str(summary.size),
            str(summary.shift),
            str(summary.gain),
            str(summary.error),
            percent(summary.probability_of_none),
        )
        for summary in report.summaries
    ]
    off = [summary.name for summary in report.summaries if summary.is_off]
    listed = (
        f"more probable than not for: {', '.join(off)}" if off else "probable for none"
    )
    parts = [
        paragraph(
            "Each entry of the measurements was compared with simulations at the known "
            "parameters, by itself: measured = mean + shift + gain (simulated - "
            f"mean) + error. A discrepancy is {listed}."
        ),
        table(
            ("entry", "size", "shift", "gain", "error", "no discrepancy"),
            rows,
            alarming=[k for k, s in enumerate(report.summaries) if s.is_off],
        ),
        paragraph(
            "Estimates with 95 % intervals, which assume that there is a discrepancy. "
            "The size is in standard deviations of simulations, shift and error are in "
            "units of the entry. The last column is the probability that the "
            "simulator is right about the entry.",
            kind="note",
        ),
        picture(discrepancy(report), caption="The same as a picture.", wide=True),
    ]
    parts += [paragraph(note) for note in report.notes]
    return section("Where the simulator differs from reality", *parts)


def no_discrepancy_section(report: StackingReport) -> str:
    """Return why the entries of x are not compared with simulations."""
    candidates = report.cross_validation.families
    why = "no candidate of this stack models how reality differs from the simulator"
    if any("discrepancy" in family for family in candidates):
        why = (
            "measurements are no short vectors here (but images, long series or sets "
            "of trials, say), or because some entries are missing"
        )
    return section(
        "Where the simulator differs from reality",
        paragraph(
            f"Entries of the measurements were not compared one by one, because {why}. "
            "The report of a DiscrepancyNPE can compare summaries of them."
        ),
    )


def diagnosis_section(diagnosis: Diagnosis, names: Sequence[str]) -> str:
    """Return the findings about a batch."""
    shown = (*diagnosis.unexpected, *diagnosis.expected)
    return section(
        "Diagnosis of the batch",
        paragraph(
            f"{len(diagnosis.distance)} measurements were compared with "
            f"{len(diagnosis.theta)} simulations: {diagnosis.verdict}"
        ),
        *_other_names(diagnosis.parameter_names, names),
        *(
            finding(
                result.name,
                result.number,
                _in_words(result),
                alarming=not result.is_expected,
            )
            for result in shown
        ),
        *_no_alarm(diagnosis.quiet),
        *_of_others(diagnosis.others),
        *(paragraph(note, kind="note") for note in diagnosis.notes),
        picture(
            implied_parameters(diagnosis),
            caption="The parameters that the batch implies, beside the prior.",
            wide=len(diagnosis.parameter_names) > 2,
        ),
    )


def _other_names(own: Sequence[str], names: Sequence[str]) -> list[str]:
    """Say which names of the diagnosis mean which parameters, where they differ."""
    renamed = [
        f"{before} is {name}"
        for before, name in zip(own, names, strict=True)
        if before != name
    ]
    return [paragraph(f"In this section {', '.join(renamed)}.")] if renamed else []


def _in_words(result: Finding) -> str:
    if result.is_expected:
        return f"{result.sentence} It is as expected {why_expected(result)}."
    return f"{result.sentence} {whom_it_concerns(result)}"


def _no_alarm(quiet: Sequence[Finding]) -> list[str]:
    if not quiet:
        return []
    return [
        paragraph("No alarm:"),
        table(
            ("finding", "number", "whose posterior it would be about"),
            [
                (result.name, result.number, IN_BRIEF[result.concerns])
                for result in quiet
            ],
        ),
    ]


def _of_others(others: Sequence[Finding]) -> list[str]:
    if not others:
        return []
    return [
        paragraph(f"{OF_OTHERS[0].upper()}{OF_OTHERS[1:]}:"),
        table(
            ("finding", "number", "alarming"),
            [
                (result.name, result.number, "yes" if result.alarming else "no")
                for result in others
            ],
        ),
    ]
