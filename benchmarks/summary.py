"""What all suites say together: a page beside the tables, and blocks of other pages."""

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from benchmarks.blocks import check_blocks, fill_blocks
from benchmarks.evidence import draw_evidence, evidence_lines, lines_of_losses
from benchmarks.excerpts import EXCERPTS, Excerpt
from benchmarks.methods import METHODS, STACK, STACKS
from benchmarks.other_suites import other_suites
from benchmarks.prices import Prices
from benchmarks.published import (
    FIXED,
    LETTERS,
    PAPER,
    SIZE,
    Published,
    acauc_text,
    both_texts,
    entry,
    lpp_text,
    mean,
    num_repetitions,
    runs_of,
    table,
)
from benchmarks.readme import readme_lines
from benchmarks.statements import (
    STATEMENTS,
    TOLERANCE,
    VERDICTS,
    verdict,
    write_statements,
)
from benchmarks.table import COUNTED, Table
from sbi_rope._files import write_atomically

__all__ = ["page_of", "write_summary"]

# The names of the blocks that are not only a table.
ALL_TASKS, FOR_README, LOSSES = "all-tasks", "readme", "not-the-best"
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
there holds for that model. Means are over all repetitions in which a method was run. If
these are fewer than those of others on the same task, their number stands beside the
mean in square brackets. Differences between methods are means over the repetitions that
both were run in. A dash is what was not run.
"""
SETTINGS = f"""\
OT-only and RoPE compete in one setting, fixed beforehand: gamma {FIXED.gamma:g} in
units of the median distance between simulated embeddings, tau {FIXED.tau:g}. The
others, among them the paper's gamma {PAPER.gamma:g} of the embedding, are shown below
and do not compete. **Bold** is the best LPP of those that do and have a score in all
repetitions of the task.
"""


def write_summary(folder: Path, *, pages: Sequence[Path]) -> Path:
    """Write `README.md` into a folder of suites, and the blocks of other pages anew.

    The same tables give the same bytes.

    Raises:
        SystemExit: If there are no results, or one of the pages has no place for a
            block.
    """
    published = Published.read(folder)
    summary = folder / "README.md"
    blocks = _blocks(published, summary)
    # Before the work, because a page without a place is refused.
    for page in pages:
        check_blocks(page, [*blocks])
    texts = {summary: page_of(published)}
    texts |= {page: fill_blocks(page, blocks) for page in pages}
    draw_evidence(published, folder)
    for path, text in texts.items():
        with write_atomically(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return summary


def _blocks(
    published: Published, summary: Path
) -> dict[str, Callable[[Path], list[str]]]:
    """Return what writes each block of a page, by the name of the block."""

    def with_link(
        lines_of: Callable[[Published, str], list[str]],
    ) -> Callable[[Path], list[str]]:
        return lambda page: lines_of(
            published, Path(os.path.relpath(summary, page.parent)).as_posix()
        )

    def table_of(excerpt: Excerpt) -> Callable[[Path], list[str]]:
        return lambda page: excerpt.markdown(published)

    tables = {name: table_of(excerpt) for name, excerpt in EXCERPTS.items()}
    texts = {ALL_TASKS: with_link(_block), FOR_README: with_link(readme_lines)}
    return {**texts, LOSSES: lambda page: lines_of_losses(published), **tables}


def page_of(published: Published) -> str:
    """Return the page of all results in Markdown."""
    both = ("OT-only", "RoPE")
    lines = [
        *("# Results of the benchmark", "", UNITS),
        *("`python -m benchmarks summary` writes this page from the tables.", ""),
        *("## What was run", "", *_overview(published), ""),
        *(f"## All tasks, {SIZE} calibration pairs", "", SETTINGS),
        *("LPP:", "", *_main(published, lpp_text, with_settings=both), ""),
        *("ACAUC:", "", *_main(published, acauc_text, with_settings=both), ""),
        *("## The stack against all others", "", *evidence_lines(published), ""),
        *("## RoPE with fewer and more calibration pairs", ""),
        *(f"LPP (ACAUC), {FIXED}.", "", *_by_size(published), ""),
        *("## What the paper states", "", *write_statements(published), ""),
        *("## Where RoPE loses", "", *_losses(published), ""),
        *("## What the other suites say", *other_suites(published)),
    ]
    return "\n".join(lines) + "\n"


def _block(published: Published, link: str) -> list[str]:
    counts = Counter(verdict(s.check(published)) for s in STATEMENTS)
    verdicts = ", ".join(f"{counts[what]} {what}" for what in VERDICTS if counts[what])
    return [
        f"LPP with {SIZE} calibration pairs, in standard deviations of the prior: the",
        "mean ± the standard deviation over repetitions. A method that was run in",
        "fewer of them has their number in square brackets. Bold is the best of the",
        "others. RoPE and OT-only compete in one setting, fixed beforehand: gamma",
        f"{FIXED.gamma:g} in units of the median distance, tau {FIXED.tau:g}.",
        *("", *_main(published, lpp_text, with_settings=("RoPE",)), ""),
        *(_in_words(_compared(published)), ""),
        *_stack_in_words(published),
        f"Of {len(STATEMENTS)} statements of the paper: {verdicts}.",
        "All results, and the rules behind these counts: [results of the "
        f"benchmark]({link}).",
    ]


def _overview(published: Published) -> list[str]:
    lines = []
    prices = Prices([known.finished for known in published.tables.values()])
    for name, suite in published.suites.items():
        if name in LEFT_OUT:
            continue
        known = published.tables.get(name, Table.of({}, {}))
        there = set(known.rows.index)
        statuses = known.statuses(suite.cells)
        complete, stand_ins = [], []
        for where, runs in runs_of(suite).items():
            place = " ".join(where).strip()
            whole = sum(there.issuperset(run) for run in runs)
            complete.append(f"{place} {whole}/{len(runs)}")
            cells = [cell for run in runs for cell in run if cell in there]
            if (known.rows["stand_in"][cells] == True).any():  # noqa: E712
                stand_ins.append(place)
        lines.append(
            [
                f"[{name}]({name}/report.md)" if there else name,
                *(statuses.count(status) for status in COUNTED),
                prices.of(known.not_run(suite)),
                ", ".join(complete) if there else "none",
                ", ".join(stand_ins),
            ]
        )
    head = ("suite", *COUNTED, "hours", "complete repetitions")
    return [
        "Hours are what one core would take for what was not run, without the training",
        "of NPE, by the times of the cells most like it. ? is a cell of a method that",
        "was never run.",
        "",
        *table((*head, "stand-ins among what was run"), lines),
    ]


# The suite main ---------------------------------------------------------------------


def _tasks(published: Published) -> list[str]:
    run = set(published.rows["main"]["task"])
    return [task for task in LETTERS if task in run]


def _main(
    published: Published,
    text: Callable[[pd.DataFrame], str],
    *,
    with_settings: Sequence[str],
) -> list[str]:
    """Return a table of methods and tasks, and of some methods in other settings."""
    tasks = _tasks(published)
    columns = [
        {name: published.select(name, task=task) for name in METHODS} for task in tasks
    ]
    counts = [num_repetitions(column.values()) for column in columns]
    bold = [
        _best(column, count) if text is lpp_text else None
        for column, count in zip(columns, counts, strict=True)
    ]
    lines = [["repetitions", *map(str, counts)]]
    for name in METHODS:
        entries = [
            entry(column[name], text, out_of=count)
            for column, count in zip(columns, counts, strict=True)
        ]
        if any(len(column[name]) for column in columns):
            marked = [
                f"**{entry}**" if name == best else entry
                for entry, best in zip(entries, bold, strict=True)
            ]
            lines.append([name, *marked])
    for name in with_settings:
        for setting in OTHER_SETTINGS:
            entries = [
                entry(
                    published.select(name, task=task, setting=setting),
                    text,
                    out_of=count,
                )
                for task, count in zip(tasks, counts, strict=True)
            ]
            lines.append([f"{name} ({setting})", *entries])
    missing = [f"{LETTERS[task]} {task}" for task in LETTERS if task not in tasks]
    return [
        *table(("", *(published.name(task) for task in tasks)), lines),
        *(["", f"Not run: {', '.join(missing)}."] if missing else []),
    ]


def _best(rows: dict[str, pd.DataFrame], repetitions: int) -> str | None:
    """Return the method with the best mean among those of all repetitions."""
    scores = {
        name: mean(part)
        for name, part in rows.items()
        if name != "SBI" and (part["status"] == "finished").sum() == repetitions
    }
    known = {name: score for name, score in scores.items() if score is not None}
    best = max(known, key=known.__getitem__, default=None)
    return best if best and known[best] > -math.inf else None


def _by_size(published: Published) -> list[str]:
    sizes = sorted({size for task in LETTERS for size in published.sizes(task)})
    lines = []
    for task in _tasks(published):
        others = {
            name: published.select(name, task=task)
            for name in ("prior", "OT-only", "SBI")
        }
        parts = [published.select("RoPE", task=task, size=size) for size in sizes]
        count = num_repetitions([*others.values(), *parts])
        text = partial(entry, text=both_texts, out_of=count)
        entries = {name: text(rows) for name, rows in others.items()}
        rope = [text(part) for part in parts]
        ends = entries["prior"], entries["OT-only"]
        lines.append([published.name(task), *ends, *rope, entries["SBI"]])
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
                for other in METHODS
                # A stack may contain RoPE.
                if other not in ("RoPE", "SBI", *STACKS)
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


def _stack_in_words(published: Published) -> list[str]:
    """Say how often the stack, which is tuned by nobody, is the best of all."""
    results = []
    for task in _tasks(published):
        for size in published.sizes(task):
            gaps = [
                published.above(STACK, other, task=task, size=size)
                for other in METHODS
                if other not in ("SBI", *STACKS)
            ]
            known = [gap for gap in gaps if gap is not None]
            if known:
                results.append(min(known) >= 0)
    if not results:
        return []
    return [
        "The [stack](stacking.md) has the best LPP of all methods, other stacks apart, "
        f"in {sum(results)} of the {len(results)} cells that it was run in.",
        "",
    ]


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
                *(published.name(task), str(size), f"{lpp:.2f}"),
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
