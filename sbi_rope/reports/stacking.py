"""The report of a stack as an HTML page, for readers who do not know this package."""

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from sbi_rope.diagnosis import Diagnosis
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.errors import InvalidInputError, shown
from sbi_rope.plots._figures import new_figure
from sbi_rope.plots.stacking import draw_learning_curve, draw_scores, draw_weights
from sbi_rope.reports.evidence import (
    calibration_section,
    diagnosis_section,
    discrepancy_section,
    no_discrepancy_section,
)
from sbi_rope.reports.page import (
    definitions,
    number,
    page,
    paragraph,
    percent,
    picture,
    section,
    table,
    verdict,
    write_page,
)
from sbi_rope.reports.verdict import verdict_of
from sbi_rope.settings import check, default_names, names_of
from sbi_rope.stacking import StackingReport
from sbi_rope.stacking.words import (
    IF_MOSTLY_PRIOR,
    IN_WORDS,
    MOSTLY,
    are_relative,
    differs,
    gains_of,
)

__all__ = ["write_stacking_report"]

TITLE = "Repaired posterior: report"
# The most candidates in the table of scores.
MAX_ROWS = 12

GLOSSARY = {
    "Simulator, posterior, NPE": "The simulator predicts measurements from parameters. "
    "The posterior says which parameters explain a measurement, and how well. Neural "
    "posterior estimation (NPE) learns it from simulations, and is wrong where the "
    "simulator is.",
    "Calibration pairs": "Real measurements whose parameters are known from elsewhere.",
    "Nat": "The unit of log scores. One nat more means that the known parameters have "
    "2.7 times the probability density, in the geometric mean over pairs. Differences "
    "are the same in all units of the parameters.",
    "95 % interval": "The range that, in 95 of 100 repetitions, holds the value that "
    "very many pairs would give.",
    "Coverage": "How many known parameters lie inside the intervals that claim a "
    "certain probability. For a calibrated posterior the two agree at every level.",
    "ACAUC": "The average difference between the probability that intervals claim and "
    "the share of known parameters inside them. 0 is calibrated, positive is "
    "over-confident (intervals too narrow), negative is too wide.",
}


def write_stacking_report(
    report: StackingReport,
    path: str | PathLike[str],
    *,
    diagnosis: Diagnosis | None = None,
    parameter_names: Sequence[str] | None = None,
    x_names: Sequence[str] | None = None,
) -> None:
    """Write the report of a stack as one HTML file.

    The arguments are those of :meth:`StackingReport.to_html
    <sbi_rope.stacking.StackingReport.to_html>`.
    """
    check("report", report, StackingReport)
    check("diagnosis", diagnosis, Diagnosis | None)
    names = _parameter_names(report, diagnosis, parameter_names)
    discrepancy = _named(report.discrepancy, x_names)
    parts = [
        paragraph(_what_was_done(report)),
        verdict(verdict_of(report, diagnosis, names)),
        _score_section(report),
        _weight_section(report),
    ]
    if report.acauc.verdict != "unknown":
        parts.append(calibration_section(report, names))
    parts.append(
        no_discrepancy_section(report)
        if discrepancy is None
        else discrepancy_section(discrepancy)
    )
    if diagnosis is not None:
        parts.append(diagnosis_section(diagnosis, names))
    parts += [_provenance_section(report), _glossary()]
    write_page(Path(path).expanduser(), page(TITLE, *parts))


def _parameter_names(
    report: StackingReport,
    diagnosis: Diagnosis | None,
    names: Sequence[str] | None,
) -> list[str]:
    count = report.levels.shape[1]
    if diagnosis is not None and len(diagnosis.parameter_names) != count:
        raise InvalidInputError(
            f"Expected `diagnosis` of a batch with {count} parameters, as the report "
            f"has; got {len(diagnosis.parameter_names)}."
        )
    if names is not None:
        return list(names_of(names, count))
    if report.parameter_names is not None:
        return list(report.parameter_names)
    if diagnosis is not None:
        return list(diagnosis.parameter_names)
    return list(default_names(count))


def _named(
    discrepancy: DiscrepancyReport | None, names: Sequence[str] | None
) -> DiscrepancyReport | None:
    if names is None:
        return discrepancy
    if discrepancy is None:
        raise InvalidInputError(
            "Expected no `x_names`, because this report does not compare the entries "
            f"of x; got {shown(names)}."
        )
    return discrepancy.renamed(names)


def _what_was_done(report: StackingReport) -> str:
    scores = report.cross_validation
    n, d = report.levels.shape
    of_groups = ""
    if scores.groups is not None:
        of_groups = f" in {len(scores.groups.unique())} groups (each counts once)"
    known, scored = f"whose {d} parameters are known", "known parameters"
    if scores.labels:
        known = f"with labels of their {d} parameters ({scores.labels})"
        scored = "labels"
    return (
        "A neural posterior estimate (NPE) was trained on simulations, and the "
        "simulator may be wrong about the real measurements. It was repaired with "
        f"{n} real measurements{of_groups} {known}: {len(scores.names)} "
        "candidate posteriors learned from a part of them and were scored by the "
        f"probability density that they give to the {scored} of the others. "
        "The result is the average of the candidates, weighted by these scores, and "
        "is called the stack."
    )


def _score_section(report: StackingReport) -> str:
    rows = report.as_rows()
    shown = rows[:MAX_ROWS]
    cells = [_score_cells("the stack", "", report.score, report.score_z)]
    if differs(report):
        scores = report.cross_validation
        in_units = scores.in_units_of_prior(scores.scores_of("stack"))
        of_prior = scores.mean_and_error(in_units)
        name = "the stack, uncorrected"
        cells.append(_score_cells(name, "", report.comparable_score, of_prior))
    cells += [
        _score_cells(
            row["candidate"],
            percent(row["weight"]),
            (row["score"], row["standard_error"]),
            (row["score_z"], row["standard_error_z"]),
        )
        for row in shown
    ]
    figure, axes = new_figure(5.4, 1.4 + 0.3 * len(shown))
    draw_scores(axes, report)
    notes = [
        "Mean log density of the known parameters, in nats a measurement; higher is "
        "better. In the first column parameters have their own units, in the second "
        "they are in standard deviations of the prior, which adds a constant."
    ]
    if are_relative(report):
        notes = [
            "Mean log density at the draws of a label, relative to that of the prior, "
            "in nats a measurement; higher is better."
        ]
    if differs(report):
        notes.append(
            "The stack is corrected for what it puts outside the range of the prior. "
            "The candidates are not, because the correction of a single one can have "
            "no end. Compare them with the uncorrected stack, as the difference from "
            "NPE above does."
        )
    if len(rows) > len(shown):
        notes.append(
            f"{len(rows) - len(shown)} candidates with lower scores are left out."
        )
    return section(
        "Scores on measurements that a posterior had not seen",
        table(
            (
                "posterior",
                "weight",
                "nats, own units",
                "nats, prior sd",
                "± standard error",
            ),
            cells,
            numbers=(1, 2, 3, 4),
            strong=(0,),
        ),
        *(paragraph(note, kind="note") for note in notes),
        picture(
            figure,
            caption="Held-out scores of the best candidates and of the stack, with one "
            "standard error to each side.",
        ),
    )


def _score_cells(
    name: str, weight: str, own: tuple[float, float], z: tuple[float, float]
) -> tuple[str, ...]:
    """Return a line of the table, from scores in two units and their errors."""
    # With partial labels the error depends on the unit. Some priors have no second one.
    error = own[1] if math.isnan(z[0]) else z[1]
    return name, weight, number(own[0]), number(z[0]), number(error)


def _weight_section(report: StackingReport) -> str:
    weights, families = report.family_weights, report.cross_validation.families
    figure, axes = new_figure(5.4, 1.2 + 0.32 * len(weights))
    draw_weights(axes, weights)
    parts = [
        table(
            ("method", "candidates", "weight", "what it is"),
            [
                (name, str(families.count(name)), percent(w), IN_WORDS.get(name, ""))
                for name, w in weights.items()
            ],
            numbers=(1, 2),
        ),
        picture(figure, caption="The weight of each method in the stack."),
    ]
    if weights.get("prior", 0.0) >= MOSTLY:
        parts.append(paragraph(f"{IF_MOSTLY_PRIOR}.", kind="note"))
    curve = report.learning_curve
    if curve is not None:
        figure, axes = new_figure(5.4, 3.2)
        draw_learning_curve(axes, curve)
        parts.append(
            picture(
                figure,
                caption="Held-out score of the stack when it is trained on fewer "
                "pairs, with one standard error to each side.",
            )
        )
        parts += [paragraph(line, kind="note") for line in gains_of(curve)]
    return section("What the stack is made of", *parts)


def _provenance_section(report: StackingReport) -> str:
    scores = report.cross_validation
    rows = [
        ("calibration pairs", str(len(scores))),
        *([("labels", scores.labels)] if scores.labels else []),
        ("folds", str(scores.num_folds)),
        ("candidates", str(len(scores.names))),
    ]
    rows += list(report.provenance.items())
    return section("How it was made", table(None, rows))


def _glossary() -> str:
    return section("Words", definitions(GLOSSARY))
