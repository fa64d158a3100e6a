"""A suite's tables in Markdown and its figures, from the committed results alone."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ttest_rel

from benchmarks import figures
from benchmarks.cells import Cell, Suite
from benchmarks.methods import ORDER
from benchmarks.store import write_atomically
from benchmarks.tables import Table, group_by, mean_and_spread

__all__ = ["label_of", "write_report"]

# Lines to compare with, not methods that compete.
REFERENCES = ("SBI",)
SIGNIFICANT = 0.05
MAX_LISTED = 30

EXPLANATION = """\
LPP: mean log-probability of the true parameters, in standard deviations of the prior
(higher is better); one observation with density zero makes it -inf. ± is the standard
deviation over repetitions. ACAUC: 0 is calibrated, above 0 over-confident, below 0
under-confident. ECE: expected coverage error, the mean distance of the coverage of
central intervals from their level. **Bold** is the best LPP of a column; an asterisk
marks those that are not significantly worse (paired t-test over test observations, 5 %;
it does not know how a method varies from training to training). SBI is NPE on
simulations instead of real observations, and does not compete. NPE and the other
posteriors of sbi are scored without leakage correction and without rejection. Methods
that see no labels stand in the column "-". gamma is in units of the median distance
between simulated embeddings (`simulated`), or in the units of the embedding as in the
paper (`none`).
"""


def write_report(suite: Suite, table: Table, folder: Path) -> Path:
    """Write `report.md` and its figures into a folder.

    The same table gives the same bytes.
    """
    finished = {
        cell: row for cell, row in table.rows.items() if row["status"] == "finished"
    }
    lines = [f"# {suite.title}", "", suite.question, "", EXPLANATION]
    lines += [f"Settings: `{preset}`." for (preset,) in group_by(suite.cells, "preset")]
    for where, cells in group_by(suite.cells, "task", "variant", "options").items():
        rows = {cell: finished[cell] for cell in cells if cell in finished}
        lines += ["", f"## {_title(where, rows.values())}", ""]
        lines += _section(rows, table) if rows else ["Not run."]
    for name, what in figures.draw_all(suite, table, folder):
        lines += ["", f"![{what}]({name})"]
    lines += ["", "## Where RoPE loses", "", *_losses(finished, table)]
    lines += ["", "## What was not run", "", *_missing(suite, table)]
    path = folder / "report.md"
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    return path


def label_of(cell: Cell, *, settings: int = 2) -> str:
    """Name a method, with gamma and tau if there are several settings of it."""
    if cell.gamma is None or settings < 2:
        return cell.method
    scale = " of the embedding" if cell.cost_scale == "none" else ""
    return f"{cell.method} (gamma {cell.gamma:g}{scale}, tau {cell.tau:g})"


def labels_of(cells: Iterable[Cell]) -> dict[Cell, str]:
    """Name the method of each cell as briefly as they can be told apart."""
    labels = {}
    for _, group in group_by(cells, "method").items():
        settings = {(cell.gamma, cell.tau, cell.cost_scale) for cell in group}
        for cell in group:
            labels[cell] = label_of(cell, settings=len(settings))
    return labels


def _title(where: tuple[Any, ...], rows: Iterable[dict[str, Any]]) -> str:
    task, variant, options = where
    title = task
    if variant:
        title += f", {variant}"
    if options != "{}":
        title += f", {options}"
    if any(row["stand_in"] for row in rows):
        title += " (a model stands in for the recorded data)"
    return title


def _section(rows: dict[Cell, dict[str, Any]], table: Table) -> list[str]:
    labels = labels_of(rows)
    sizes = sorted({cell.n_calibration for cell in rows})
    names = sorted(set(labels.values()), key=lambda name: _rank(name, labels))
    heads = ["-" if size == 0 else str(size) for size in sizes]
    marks = {size: _marks(rows, labels, size, table) for size in sizes if size}
    lines = [
        f"{next(iter(rows.values()))['n_test']} test observations, "
        f"{len({cell.repetition for cell in rows})} repetition(s).",
        "",
    ]
    for score, text in (("LPP", _lpp), ("ACAUC (ECE)", _calibration)):
        columns = " | ".join(heads)
        lines.append(f"| {score}, calibration pairs | {columns} |")
        lines.append("|---" * (len(heads) + 1) + "|")
        for name in names:
            entries = []
            for size in sizes:
                of_cell = [
                    rows[cell]
                    for cell in rows
                    if labels[cell] == name and cell.n_calibration == size
                ]
                entry = text(of_cell) if of_cell else ""
                if entry and score == "LPP":
                    entry = _marked(entry, name, size, marks)
                entries.append(entry)
            lines.append(f"| {name} | {' | '.join(entries)} |")
        lines.append("")
    return lines[:-1]


def _rank(name: str, labels: dict[Cell, str]) -> tuple[int, Any]:
    cell = next(cell for cell, label in labels.items() if label == name)
    setting = (cell.cost_scale, cell.gamma, cell.tau)
    return ORDER.index(cell.method), setting if cell.gamma is not None else ()


def _lpp(rows: Sequence[dict[str, Any]]) -> str:
    mean, spread = mean_and_spread([row["lpp_z"] for row in rows])
    text = f"{mean:.2f}" if math.isfinite(mean) else "-inf"
    if math.isfinite(spread):
        text += f" ± {spread:.2f}"
    if any(not row["converged"] for row in rows):
        text += " (not converged)"
    return text


def _calibration(rows: Sequence[dict[str, Any]]) -> str:
    acauc, _ = mean_and_spread([row["acauc"] for row in rows])
    error, _ = mean_and_spread([row["expected_coverage_error"] for row in rows])
    return f"{acauc:+.3f} ({error:.3f})"


# Comparisons ------------------------------------------------------------------------


def _marked(entry: str, name: str, size: int, marks: dict[int, dict[str, str]]) -> str:
    if size:
        kind = marks[size].get(name)
    else:
        # Without labels a method competes in all columns.
        kinds = {of_size.get(name) for of_size in marks.values()}
        kind = "best" if kinds == {"best"} else "near" if "near" in kinds else None
    return f"**{entry}**" if kind == "best" else f"{entry}*" if kind else entry


def _marks(
    rows: dict[Cell, dict[str, Any]],
    labels: dict[Cell, str],
    size: int,
    table: Table,
) -> dict[str, str]:
    """Return which methods are best with so many pairs, or nearly."""
    scores = {}
    for cell in rows:
        if cell.n_calibration in (0, size) and cell.method not in REFERENCES:
            log_probs = table.arrays[cell].get("log_probs")
            if log_probs is not None:
                scores.setdefault(labels[cell], {})[cell.repetition] = log_probs
    if not scores:
        return {}
    pooled = {
        name: np.concatenate([parts[key] for key in sorted(parts)])
        for name, parts in scores.items()
    }
    length = max(len(values) for values in pooled.values())
    pooled = {name: v for name, v in pooled.items() if len(v) == length}
    best = max(pooled, key=lambda name: pooled[name].astype(float).mean())
    marks = {best: "best"}
    for name, values in pooled.items():
        if name != best and not worse(values, pooled[best]):
            marks[name] = "near"
    return marks


def worse(values: np.ndarray, best: np.ndarray) -> bool:
    """Whether a method's log-probabilities are significantly below another's."""
    if not np.isfinite(values).all():
        return bool(np.isfinite(best).all())
    if not np.isfinite(best).all():
        return False
    difference = values.astype(float) - best.astype(float)
    if np.ptp(difference) == 0:
        return bool(difference[0] < 0)
    return bool(
        ttest_rel(values.astype(float), best.astype(float), alternative="less").pvalue
        < SIGNIFICANT
    )


def _losses(finished: dict[Cell, dict[str, Any]], table: Table) -> list[str]:
    lines = []
    for cell, row in finished.items():
        if cell.method != "RoPE":
            continue
        for other, rival in finished.items():
            same = all(
                getattr(cell, name) == getattr(other, name)
                for name in ("task", "variant", "options", "repetition", "preset")
            )
            rivals = other.method in ("prior", "NPE") or (
                other.method == "OT-only"
                and (other.gamma, other.tau, other.cost_scale)
                == (cell.gamma, cell.tau, cell.cost_scale)
            )
            if not same or not rivals or row["lpp_z"] >= rival["lpp_z"]:
                continue
            ours = table.arrays[cell].get("log_probs")
            theirs = table.arrays[other].get("log_probs")
            surely = (
                ours is not None
                and theirs is not None
                and len(ours) == len(theirs)
                and worse(ours, theirs)
            )
            lines.append(
                f"- {cell}: {row['lpp_z']:.2f}, {other.method} {rival['lpp_z']:.2f}"
                f"{'' if surely else ' (not significant)'}"
            )
    return lines or ["Never below the prior, NPE or OT-only in a cell that was run."]


def _missing(suite: Suite, table: Table) -> list[str]:
    lines = []
    missing = [cell for cell in suite.cells if cell not in table.rows]
    failed = [cell for cell in suite.cells if _status(cell, table) == "failed"]
    if missing:
        lines.append(f"{len(missing)} of {len(suite.cells)} cells were not run:")
        lines.append("")
        groups = group_by(missing, "task", "variant", "options", "repetition")
        for (task, variant, options, repetition), cells in groups.items():
            methods = ", ".join(dict.fromkeys(cell.method for cell in cells))
            names = " ".join(n for n in (task, variant) if n)
            names += "" if options == "{}" else f" {options}"
            lines.append(f"- {names} #{repetition}: {len(cells)} cells ({methods})")
    if failed:
        lines += ["", f"{len(failed)} cells failed:", ""]
        lines += [
            f"- {cell}: {table.rows[cell]['error'].splitlines()[0][:200]}"
            for cell in failed[:MAX_LISTED]
        ]
    return lines or ["Everything was run."]


def _status(cell: Cell, table: Table) -> str:
    return table.rows[cell]["status"] if cell in table.rows else "not run"
