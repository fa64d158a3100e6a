"""The report of a stack as an HTML page, for readers who do not know this package."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from sbi_rope.diagnosis import Diagnosis
from sbi_rope.plots import discrepancy, implied_parameters, stacking_report
from sbi_rope.stacking import StackingReport
from sbi_rope.stacking.report import headline, sections_of
from sbi_rope.utils.settings import check

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass
class _Part:
    """A section of the page: sentences, a table, and a picture with its caption."""

    title: str
    lines: Sequence[tuple[str, bool]] = ()
    heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    picture: tuple[str, str] | None = None


def write_html(
    report: StackingReport,
    path: str | PathLike[str],
    *,
    diagnosis: Diagnosis | None = None,
    x_names: Sequence[str] | None = None,
) -> None:
    """Write the report of a stack as one HTML file that can be sent to somebody.

    It says what printing says, with tables and pictures, and what the words mean. It
    needs no other file, no script and no network.

    Args:
        report: The ``report`` of the posterior that :func:`sbi_rope.stack` returned.
        path: The file, which is replaced. Its folder is made if there is none.
        diagnosis: What :func:`sbi_rope.diagnose` says about a batch, if anything.
        x_names: A name for each entry of x; "x[0]" and so on if None.

    Raises:
        InvalidInputError: If there are other names than entries of x.
    """
    check("report", report, StackingReport)
    check("diagnosis", diagnosis, Diagnosis | None)
    if x_names is not None and report.discrepancy is not None:
        report = replace(report, discrepancy=report.discrepancy.renamed(x_names))
    parts = _parts(report)
    if diagnosis is not None:
        found = diagnosis.findings
        lines = [(f"{one.name}: {one.sentence}", one.alarming) for one in found]
        caption = "The parameters that the batch implies, beside the prior."
        picture = _encoded(implied_parameters(diagnosis)), caption
        parts.append(_Part("Diagnosis of the batch", lines, picture=picture))
    parts.append(_Part("How it was made", rows=list(report.provenance.items())))
    from jinja2 import Environment, PackageLoader

    environment = Environment(
        loader=PackageLoader("sbi_rope", "report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("page.html.j2").render(
        version=metadata.version("sbi-rope"),
        headline=headline(report),
        sections=parts,
    )
    file = Path(path).expanduser()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")


def _parts(report: StackingReport) -> list[_Part]:
    """Return the sections of the printed report, with their tables and pictures."""
    parts = helped, _, simulator, _ = [_Part(*one) for one in sections_of(report)]
    helped.heads = "candidate", "weight", "nats a pair", "in prior units"
    helped.rows = [
        (
            str(row["candidate"]),
            f"{row['weight']:.0%}",
            f"{row['score']:.2f} ({row['score_low']:.2f} to {row['score_high']:.2f})",
            f"{row['score_z']:.2f}",
        )
        for row in report.as_rows()
    ]
    caption = (
        "Log densities of hold-out pairs with 95 % intervals, weights, and the share "
        "of known parameters inside intervals of each level; the band holds 95 % of "
        "the curves of calibrated posteriors."
    )
    helped.picture = _encoded(stacking_report(report)), caption
    if (found := report.discrepancy) is not None:
        simulator.heads = "entry", "size", "shift", "gain", "error", "no discrepancy"
        simulator.rows = [
            (
                *(one.name, str(one.size), str(one.shift), str(one.gain)),
                *(str(one.error), f"{one.probability_of_none:.0%}"),
            )
            for one in found.summaries
        ]
        caption = (
            "measured = mean + shift + gain (simulated - mean) + error, for each entry "
            "alone, with 95 % intervals. The size is in standard deviations of "
            "simulations; the last column is the probability of no discrepancy."
        )
        simulator.picture = _encoded(discrepancy(found)), caption
    return parts


def _encoded(figure: "Figure") -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode("ascii")
