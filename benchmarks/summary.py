"""What all suites say together: a page beside the tables, a block for the README."""

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.cells import NEEDS_CALIBRATION
from benchmarks.methods import ORDER
from benchmarks.statements import (
    FIXED,
    LETTERS,
    PAPER,
    SIZE,
    STATEMENTS,
    TOLERANCE,
    VERDICTS,
    Published,
    Row,
    finished,
    gap,
    mean,
    table,
    verdict,
    write_statements,
)
from benchmarks.store import write_atomically
from benchmarks.tables import group_by, mean_and_spread

__all__ = ["write_summary"]

BEGIN, END = "<!-- results -->", "<!-- /results -->"
MISSING = "-"
# Its numbers mean nothing.
LEFT_OUT = ("smoke",)
# Shown beside FIXED; they do not compete, or one of four settings would be chosen by
# the score that is reported.
OTHER_SETTINGS = (FIXED._replace(tau=0.9), PAPER, PAPER._replace(tau=0.9))

UNITS = """\
LPP is the mean log-probability of the true parameters in standard deviations of the
prior (higher is better), ± its standard deviation over repetitions where there are
several. ACAUC is 0 for calibrated posteriors, positive for over-confident ones. SBI is
NPE on simulations instead of real observations. A to F are the tasks of the paper, G is
ours; on a stand-in a richer model takes the place of recorded data, and what is found
there holds for that model. Means are over the repetitions in which a task is complete,
or over all where none is. A dash is what was not run.
"""
SETTINGS = f"""\
OT-only and RoPE compete in one setting, fixed beforehand: gamma {FIXED.gamma:g} in
units of the median distance between simulated embeddings, tau {FIXED.tau:g}. The
others, among them the paper's gamma {PAPER.gamma:g} of the embedding, are shown below
and do not compete. **Bold** is the best LPP of those that do.
"""


def write_summary(folder: Path, readme: Path) -> Path:
    """Write `README.md` into a folder of suites, and a block of it into `readme`.

    The same tables give the same bytes.

    Raises:
        SystemExit: If there are no results, or `readme` has no place for the block.
    """
    published = Published.read(folder)
    page = folder / "README.md"
    link = Path(os.path.relpath(page, readme.parent)).as_posix()
    text = _with_block(readme, "\n".join(_block(published, link)))
    for path, content in ((page, "\n".join(_page(published)) + "\n"), (readme, text)):
        with write_atomically(path) as temporary:
            temporary.write_text(content)
    return page


def _with_block(readme: Path, block: str) -> str:
    text = readme.read_text()
    before, begin, rest = text.partition(BEGIN)
    old, end, after = rest.partition(END)
    if not begin or not end or any(m in before + old + after for m in (BEGIN, END)):
        raise SystemExit(f"{readme} needs one line {BEGIN} and, below it, one {END}.")
    return f"{before}{BEGIN}\n{block}\n{END}{after}"


def _page(published: Published) -> list[str]:
    both = ("OT-only", "RoPE")
    return [
        *("# Results of the benchmark", "", UNITS),
        *("`python -m benchmarks summary` writes this page from the tables.", ""),
        *("## What was run", "", *_overview(published), ""),
        *(f"## All tasks, {SIZE} calibration pairs", "", SETTINGS),
        *("LPP:", "", *_main(published, _lpp, with_settings=both), ""),
        *("ACAUC:", "", *_main(published, _acauc, with_settings=both), ""),
        *("## RoPE with fewer and more calibration pairs", ""),
        *(f"LPP (ACAUC), {FIXED}.", "", *_by_size(published), ""),
        *("## What the paper states", "", *write_statements(published), ""),
        *("## Where RoPE loses", "", *_losses(published), ""),
        *("## What the other suites say", *_others(published)),
    ]


def _block(published: Published, link: str) -> list[str]:
    counts = Counter(verdict(s.check(published)) for s in STATEMENTS)
    verdicts = ", ".join(f"{counts[what]} {what}" for what in VERDICTS if counts[what])
    return [
        f"LPP with {SIZE} calibration pairs, in standard deviations of the prior. Bold",
        "is the best; RoPE and OT-only compete in one setting, fixed beforehand (gamma",
        f"{FIXED.gamma:g} in units of the median distance, tau {FIXED.tau:g}).",
        *("", *_main(published, _lpp, with_settings=("RoPE",)), ""),
        *(_in_words(_compared(published)), ""),
        f"Of {len(STATEMENTS)} statements of the paper: {verdicts}.",
        f"All results, and the rules behind these counts: [{link}]({link}).",
    ]


def _name(published: Published, task: str, *, suite: str = "main") -> str:
    letter, *mark = published.name(task, suite=suite).split(" ", 1)
    return " ".join([letter, task, *mark])


def _entry(rows: Sequence[Row], text: Callable[[Sequence[Row]], str]) -> str:
    """Return scores as text, with what failed."""
    scored = finished(rows)
    if not scored:
        return "failed" if rows else MISSING
    failed = len(rows) - len(scored)
    return text(scored) + (f" ({failed} of {len(rows)} failed)" if failed else "")


def _lpp(rows: Sequence[Row]) -> str:
    text = _number([row["lpp_z"] for row in rows], ".2f")
    return text + ("" if all(r["converged"] for r in rows) else " (not converged)")


def _acauc(rows: Sequence[Row]) -> str:
    return _number([row["acauc"] for row in rows], "+.3f")


def _number(values: list[float], form: str) -> str:
    value, spread = mean_and_spread(values)
    text = f"{value:{form}}"
    return text if math.isnan(spread) else f"{text} ± {spread:{form.lstrip('+')}}"


def _both(rows: Sequence[Row]) -> str:
    return f"{mean(rows):.2f} ({mean(rows, 'acauc'):+.2f})"


# What was run -----------------------------------------------------------------------


def _overview(published: Published) -> list[str]:
    lines = []
    for name, suite in published.suites.items():
        if name in LEFT_OUT:
            continue
        rows = published.tables[name].rows if name in published.tables else {}
        statuses = [rows[c]["status"] if c in rows else "not run" for c in suite.cells]
        whole, stand_ins = [], []
        for where, cells in group_by(suite.cells, "task", "variant").items():
            parts = group_by(cells, "repetition").values()
            count = sum(all(cell in rows for cell in part) for part in parts)
            whole.append(f"{' '.join(where).strip()} {count}/{len(parts)}")
            if any(rows[cell]["stand_in"] for cell in cells if cell in rows):
                stand_ins.append(" ".join(where).strip())
        lines.append(
            [
                f"[{name}]({name}/report.md)" if rows else name,
                *(str(statuses.count(s)) for s in ("finished", "failed", "not run")),
                ", ".join(whole) if rows else "none",
                ", ".join(stand_ins),
            ]
        )
    head = ("suite", "finished", "failed", "not run", "complete repetitions")
    return table((*head, "stand-ins among what was run"), lines)


# The suite main ---------------------------------------------------------------------


def _tasks(published: Published) -> list[str]:
    run = {row["task"] for row in published.rows["main"]}
    return [task for task in LETTERS if task in run]


def _main(
    published: Published,
    text: Callable[[Sequence[Row]], str],
    *,
    with_settings: Sequence[str],
) -> list[str]:
    """Return a table of methods and tasks, and of some methods in other settings."""
    tasks = _tasks(published)
    columns = [
        {name: published.select(name, task=task) for name in ORDER} for task in tasks
    ]
    bold = [_best(column) if text is _lpp else None for column in columns]
    counts = [
        len({row["repetition"] for rows in column.values() for row in rows})
        for column in columns
    ]
    lines = [["repetitions", *map(str, counts)]]
    for name in ORDER:
        entries = [_entry(column[name], text) for column in columns]
        if any(column[name] for column in columns):
            marked = [
                f"**{entry}**" if name == best else entry
                for entry, best in zip(entries, bold, strict=True)
            ]
            lines.append([name, *marked])
    for name in with_settings:
        for setting in OTHER_SETTINGS:
            parts = [published.select(name, task=t, setting=setting) for t in tasks]
            lines.append([f"{name} ({setting})", *(_entry(p, text) for p in parts)])
    missing = [f"{LETTERS[task]} {task}" for task in LETTERS if task not in tasks]
    return [
        *table(("", *(_name(published, task) for task in tasks)), lines),
        *(["", f"Not run: {', '.join(missing)}."] if missing else []),
    ]


def _best(rows: dict[str, list[Row]]) -> str | None:
    scores = {name: mean(part) for name, part in rows.items() if name != "SBI"}
    known = {name: score for name, score in scores.items() if score is not None}
    best = max(known, key=known.__getitem__, default=None)
    return best if best and known[best] > -math.inf else None


def _by_size(published: Published) -> list[str]:
    sizes = sorted({size for task in LETTERS for size in published.sizes(task)})
    lines = []
    for task in _tasks(published):
        entries = {
            name: _entry(published.select(name, task=task), _both)
            for name in ("prior", "OT-only", "SBI")
        }
        parts = [published.select("RoPE", task=task, size=size) for size in sizes]
        rope = [_entry(part, _both) for part in parts]
        ends = entries["prior"], entries["OT-only"]
        lines.append([_name(published, task), *ends, *rope, entries["SBI"]])
    return table(("", "prior", "OT-only", *(f"{n} pairs" for n in sizes), "SBI"), lines)


# Where RoPE loses -------------------------------------------------------------------


class Compared(NamedTuple):
    """RoPE on a task with so many pairs, and how far it is above each other method."""

    task: str
    size: int
    lpp: float
    gaps: dict[str, float]


def _compared(published: Published) -> list[Compared]:
    compared = []
    for task in _tasks(published):
        for size in published.sizes(task):
            lpp = mean(published.select("RoPE", task=task, size=size))
            gaps = {
                other: published.above("RoPE", other, task=task, size=size)
                for other in ORDER
                if other not in ("RoPE", "SBI")
            }
            known = {name: value for name, value in gaps.items() if value is not None}
            if lpp is not None and known:
                compared.append(Compared(task, size, lpp, known))
    return compared


def _in_words(compared: Sequence[Compared]) -> str:
    best = sum(min(cell.gaps.values()) >= 0 for cell in compared)
    parts = []
    for name, other in (("OT-only", "OT-only"), ("prior", "the prior")):
        gaps = [cell.gaps[name] for cell in compared if name in cell.gaps]
        below, clearly = (sum(gap < -limit for gap in gaps) for limit in (0, TOLERANCE))
        parts.append(
            f"below {other} in {below} of {len(gaps)} (in {clearly} by more than "
            f"{TOLERANCE} nat)"
        )
    return (
        "Over all tasks and numbers of calibration pairs that were run, RoPE "
        f"({FIXED}) has the best LPP in {best} of {len(compared)} cells. It is "
        f"{parts[0]}, and {parts[1]}."
    )


def _losses(published: Published) -> list[str]:
    compared = _compared(published)
    lines = []
    for task, size, lpp, gaps in compared:
        best = min(gaps, key=gaps.__getitem__)
        if gaps[best] >= 0:
            continue
        losses = [gaps.get(name, 0.0) for name in ("prior", "OT-only")]
        lines.append(
            [
                *(_name(published, task), str(size), f"{lpp:.2f}"),
                *(f"{value:.2f}" if value < 0 else "" for value in losses),
                f"{gaps[best]:.2f} {best}",
            ]
        )
    winners = Counter(line[-1].split(" ", 1)[1] for line in lines)
    others = ", ".join(f"{name} {count}" for name, count in winners.most_common())
    head = ("task", "pairs", "RoPE", "to the prior", "to OT-only", "to the best other")
    return [
        _in_words(compared) + (f" Best where RoPE is not: {others}." if others else ""),
        *(["", *table(head, lines)] if lines else []),
    ]


# The other suites -------------------------------------------------------------------


def _others(published: Published) -> list[str]:
    """Return a small table of each suite that one is defined for, and that has rows."""
    tables = {
        "gamma": (_gamma, f"RoPE, {SIZE} pairs, by gamma: LPP (ACAUC)."),
        "tau": (_tau, f"RoPE, {SIZE} pairs, by tau: LPP (ACAUC)."),
        "wellspecified": (_well_specified, "RoPE above NPE, by calibration pairs."),
        "labels": (_labels, f"LPP with {SIZE} pairs, by noise on their labels in %."),
    }
    lines = []
    for name, (of_suite, what) in tables.items():
        rows = published.rows[name]
        lines += ["", f"### {published.suites[name].title}", ""]
        lines += [what, "", *of_suite(published, rows)] if rows else ["Not run."]
    return lines


def _grid(
    rows: Iterable[Row],
    *,
    line: Callable[[Row], str],
    column: Callable[[Row], float],
    text: Callable[[Sequence[Row]], str] = _both,
) -> list[str]:
    grid: dict[str, dict[float, list[Row]]] = {}
    for row in rows:
        grid.setdefault(line(row), {}).setdefault(column(row), []).append(row)
    columns = sorted({value for entries in grid.values() for value in entries})
    lines = [
        [name, *(_entry(entries.get(value, []), text) for value in columns)]
        for name, entries in grid.items()
    ]
    return table(("", *(f"{value:g}" for value in columns)), lines)


def _label(published: Published, row: Row, what: str, *methods: str) -> str:
    """Name a line, with the LPP of other methods on the same data."""
    same = {name: row[name] for name in ("task", "variant", "options")}
    lpps = [
        f"{name} {_entry(published.select(name, suite=row['suite'], **same), _lpp)}"
        for name in methods
    ]
    name = _name(published, row["task"], suite=row["suite"])
    return f"{name}, {what}" + (f" ({', '.join(lpps)})" if lpps else "")


def _gamma(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        unit = "embedding" if row["cost_scale"] == "none" else "median distance"
        return _label(published, row, f"in units of the {unit}", "prior", "SBI")

    chosen = [r for r in rows if r["method"] == "RoPE" and r["n_calibration"] == SIZE]
    return _grid(chosen, line=line, column=lambda row: row["gamma"])


def _tau(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        weight = json.loads(row["options"]).get("misspecification_weight")
        what = "prior shifted" if weight is None else f"weight {weight:g}"
        return _label(published, row, what, "prior", "NPE")

    chosen = [row for row in rows if row["method"] == "RoPE"]
    return _grid(chosen, line=line, column=lambda row: row["tau"])


def _well_specified(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        return _label(published, row, f"tau {row['tau']:g}", "prior", "NPE")

    def text(part: Sequence[Row]) -> str:
        task = part[0]["task"]
        npe = published.select("NPE", suite="wellspecified", task=task)
        difference = gap(part, npe)
        return MISSING if difference is None else f"{difference:+.2f}"

    chosen = [row for row in rows if row["method"] == "RoPE"]
    return _grid(chosen, line=line, column=lambda r: r["n_calibration"], text=text)


def _labels(published: Published, rows: list[Row]) -> list[str]:
    return _grid(
        [row for row in rows if row["method"] in NEEDS_CALIBRATION],
        line=lambda row: _label(published, row, row["method"]),
        column=lambda row: 100 * json.loads(row["options"]).get("label_noise", 0.0),
        text=_lpp,
    )
