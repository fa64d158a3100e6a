"""A suite's tables in Markdown and its figures, from the committed results alone."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from benchmarks import figures
from benchmarks.cells import Cell, Suite
from benchmarks.methods import ORDER
from benchmarks.stacking import stacking_lines
from benchmarks.tables import Table, group_by, mean_and_spread
from sbi_rope._files import write_atomically

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
marks those that are not significantly worse observation by observation (Wilcoxon's
signed-rank test over test observations, 5 %; it does not know how a method varies from
training to training, and a few observations can ruin a mean that it does not see: the
median is in the CSV). SBI is NPE on simulations instead of real observations, and does
not compete. Mixtures normalise over the support of the prior (RoPE, OT-only, the stack,
discrepancies that are tuned or fine-tuned); NPE and all other posteriors of sbi are
scored without leakage correction and without rejection. Methods that see no labels have
the same score in every column. gamma is in units of the median distance between
simulated embeddings (`simulated`), or in the units of the embedding as in the paper
(`none`).
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
    if stacked := stacking_lines(table):
        lines += ["", *stacked]
    if any(cell.method == "RoPE" for cell in suite.cells):
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
    sizes = sorted({cell.n_calibration for cell in rows} - {0}) or [0]
    names = sorted(set(labels.values()), key=lambda name: _rank(name, labels))
    marks = {size: _marks(rows, labels, size, table) for size in sizes}
    lines = [
        f"{next(iter(rows.values()))['n_test']} test observations, "
        f"{len({cell.repetition for cell in rows})} repetition(s).{_settings(rows)}",
        "",
    ]
    for score, text in (("LPP", _lpp), ("ACAUC (ECE)", _calibration)):
        heads = " | ".join("-" if size == 0 else str(size) for size in sizes)
        lines.append(f"| {score}, calibration pairs | {heads} |")
        lines.append("|---" * (len(sizes) + 1) + "|")
        for name in names:
            entries = []
            for size in sizes:
                of_cell = [
                    rows[cell]
                    for cell in rows
                    if labels[cell] == name and cell.n_calibration in (0, size)
                ]
                entry = text(of_cell) if of_cell else ""
                if entry and score == "LPP":
                    entry = _marked(entry, marks[size].get(name))
                entries.append(entry)
            lines.append(f"| {name} | {' | '.join(entries)} |")
        lines.append("")
    return lines[:-1]


def _settings(rows: Iterable[Cell]) -> str:
    """Return the setting of the couplings, where there is a single one."""
    settings = {(c.gamma, c.tau, c.cost_scale) for c in rows if c.gamma is not None}
    if len(settings) != 1:
        return ""
    ((gamma, tau, scale),) = settings
    return f" Couplings: gamma = {gamma:g} ({scale}), tau = {tau:g}."


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


def _marked(entry: str, kind: str | None) -> str:
    return f"**{entry}**" if kind == "best" else f"{entry}*" if kind else entry


def _marks(
    rows: dict[Cell, dict[str, Any]],
    labels: dict[Cell, str],
    size: int,
    table: Table,
) -> dict[str, str]:
    """Return which methods are best with so many pairs, or nearly."""
    scores: dict[str, dict[int, np.ndarray]] = {}
    for cell in rows:
        if cell.n_calibration in (0, size) and cell.method not in REFERENCES:
            log_probs = table.arrays[cell].get("log_probs")
            if log_probs is not None:
                scores.setdefault(labels[cell], {})[cell.repetition] = log_probs
    means = {
        name: float(np.mean([part.astype(float).mean() for part in parts.values()]))
        for name, parts in scores.items()
    }
    if not means or max(means.values()) == -math.inf:
        return {}
    best = max(means, key=means.__getitem__)
    marks = {best: "best"}
    for name, parts in scores.items():
        # Of repetitions that both have: only these are the same observations.
        common = sorted(parts.keys() & scores[best].keys())
        if name == best or not common:
            continue
        ours, others = (
            np.concatenate([scores[which][repetition] for repetition in common])
            for which in (name, best)
        )
        if len(ours) == len(others) and not worse(ours, others):
            marks[name] = "near"
    return marks


def worse(values: np.ndarray, best: np.ndarray) -> bool:
    """Whether log-probabilities are significantly below another method's.

    By ranks of the differences: one observation that is far off would hide all others
    from a t-test.
    """
    lost, theirs = np.isneginf(values), np.isneginf(best)
    if lost.sum() != theirs.sum():
        return bool(lost.sum() > theirs.sum())
    finite = ~lost & ~theirs
    difference = values[finite].astype(float) - best[finite].astype(float)
    if not np.any(difference):
        return False
    return bool(wilcoxon(difference, alternative="less").pvalue < SIGNIFICANT)


def _losses(finished: dict[Cell, dict[str, Any]], table: Table) -> list[str]:
    """List the cells of RoPE that another method beats with as many pairs, or none."""
    lines = []
    for cell, row in finished.items():
        if cell.method != "RoPE":
            continue
        rivals = []
        for other, rival in finished.items():
            same = all(
                getattr(cell, name) == getattr(other, name)
                for name in ("task", "variant", "options", "repetition", "preset")
            )
            setting = (other.gamma, other.tau, other.cost_scale)
            comparable = other.n_calibration in (0, cell.n_calibration) and (
                other.gamma is None
                or setting == (cell.gamma, cell.tau, cell.cost_scale)
            )
            if other.method in (*REFERENCES, "RoPE") or not same or not comparable:
                continue
            if row["lpp_z"] < rival["lpp_z"]:
                sure = _surely_worse(table, cell, other)
                rivals.append(
                    f"{other.method} {rival['lpp_z']:.2f}"
                    f"{'' if sure else ' (not significant)'}"
                )
        if rivals:
            lines.append(f"- {cell}: {row['lpp_z']:.2f}; {', '.join(rivals)}")
    return lines or ["In no cell that was run."]


def _surely_worse(table: Table, cell: Cell, other: Cell) -> bool:
    ours = table.arrays[cell].get("log_probs")
    theirs = table.arrays[other].get("log_probs")
    if ours is None or theirs is None or len(ours) != len(theirs):
        return False
    return worse(ours, theirs)


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
