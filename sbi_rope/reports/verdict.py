"""The verdict of a page: the box with what matters most."""

from collections.abc import Sequence

from sbi_rope.diagnosis import Diagnosis
from sbi_rope.diagnosis.report import UNLIKE_PAIRS
from sbi_rope.metrics.calibration import FEWEST
from sbi_rope.reports.page import number, percent
from sbi_rope.stacking import StackingReport
from sbi_rope.stacking.words import (
    LEVEL,
    NOT_CHECKED,
    ON_AVERAGE,
    OVER_CONFIDENT,
    TOO_FEW,
    compared,
    coverage_by_estimate,
    depends_on_estimate,
    is_comparable,
    not_the_prior,
    parameters_off,
)

__all__ = ["verdict_of"]


def verdict_of(
    report: StackingReport, diagnosis: Diagnosis | None, names: Sequence[str]
) -> list[tuple[str, bool]]:
    """Return the sentences of the verdict, and whether each is alarming."""
    lines = []
    for name, gain in report.gains.items():
        line = f"The stack is {compared(gain, name)}"
        if is_comparable(gain):
            line += f": {number(gain.mean, sign=True)} nats a measurement, 95 % "
            line += f"interval {number(gain.low, sign=True)} to "
            line += number(gain.high, sign=True)
        lines.append((f"{line}.", gain.high < 0))
    lines.append(_calibrated(report))
    lines += [(f"{line}.", True) for line in parameters_off(report, names)]
    if depends_on_estimate(report):
        found = coverage_by_estimate(report, names)
        lines += [(f"{_sentence(line)}.", True) for line in found]
    if what_follows := not_the_prior(report):
        start = "The known parameters are not distributed as the prior assumes."
        lines.append((f"{start} {what_follows}", True))
    lines.append(_assumption(report, diagnosis))
    if diagnosis is not None:
        lines.append(
            (
                f"The diagnosis of a batch of {len(diagnosis.distance)} measurements: "
                f"{diagnosis.verdict}",
                bool(diagnosis.alarming),
            )
        )
    return lines


def _sentence(line: str) -> str:
    return line[0].upper() + line[1:]


def _calibrated(report: StackingReport) -> tuple[str, bool]:
    verdict = report.acauc.verdict
    if verdict == "unknown":
        return f"{_sentence(NOT_CHECKED)}.", False
    if report.cross_validation.effective_number < FEWEST:
        return f"There are {TOO_FEW}: ACAUC {report.acauc.value:+.3f}.", False
    known = "known parameters"
    if report.cross_validation.score_errors is not None:
        known = "measured values, with any noise of their labels"
    held = percent(report.share_inside)
    inside = f"{percent(LEVEL)} intervals held {held} of the {known}."
    if verdict == "calibrated":
        average = ON_AVERAGE if parameters_off(report) else ""
        start = f"Its uncertainties are calibrated{average} as far as these pairs can "
        start += "tell"
        return f"{start}: {inside}", False
    text = f"On held-out pairs its uncertainties are {verdict}: {inside}"
    return f"{text} {OVER_CONFIDENT}" if verdict == "over-confident" else text, True


def _assumption(
    report: StackingReport, diagnosis: Diagnosis | None
) -> tuple[str, bool]:
    start = "All this holds for measurements like those of the calibration pairs."
    batches = _compared_batches(report, diagnosis)
    for whose, p_value, is_different in batches:
        if is_different:
            text = f"{whose} differs from them (p = {p_value:.3f}), so that it need not"
            return f"{start} {text} hold there.", True
    if batches:
        whose, p_value, _ = batches[0]
        text = f"{whose} shows no sign of a difference (p = {p_value:.2f})."
    elif diagnosis is not None:
        text = "Whether the batch of the diagnosis is like them was not tested."
    else:
        text = "This report does not compare others with them."
    return f"{start} {text}", False


def _compared_batches(
    report: StackingReport, diagnosis: Diagnosis | None
) -> list[tuple[str, float, bool]]:
    """Return which batches were compared with the pairs, p-values and verdicts."""
    found = []
    if report.batch is not None:
        test = report.batch
        found.append(
            ("The batch of unlabelled measurements", test.p_value, test.is_different)
        )
    if diagnosis is not None:
        finding = diagnosis[UNLIKE_PAIRS]
        if finding.value is not None:
            whose = "The batch of the diagnosis"
            found.append((whose, finding.value, finding.alarming))
    return found
