"""Tables of README, of the page of all results, and of pages of docs.

A page has a place for each of its tables,

    <!-- results: NAME -->
    <!-- /results -->

and `write_pages` writes them anew. All else on a page is written by hand.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.cells import Cell
from benchmarks.methods import GIVEN_PRIOR_STACK, METHODS, STACK, methods_where
from benchmarks.published import (
    FIXED,
    LETTERS,
    MAX_PAIRS,
    PAPER,
    SIZE,
    Comparison,
    Published,
    against_candidates,
    compare,
    finished,
    half_width,
    mean,
    num_repetitions,
)
from benchmarks.store import WHERE, Results
from sbi_rope._files import write_atomically

__all__ = ["BLOCK", "BLOCKS", "pages_with_blocks", "write_pages"]

END = "<!-- /results -->"
BLOCK = re.compile(rf"(<!-- results: ([\w-]+) -->\n)(.*?){END}", re.DOTALL)
# What begins or ends a block, also one that is not whole.
MARKER = re.compile(r"<!-- /?results")
MISSING = "-"
# Numbers of pairs that are shown side by side.
FEW = (10, 50, 200)
Lines = list[str]
# What `Published.select` is asked for.
Fields = dict[str, Any]


def pages_with_blocks(root: Path) -> list[Path]:
    """Return the pages of a project that have places for tables."""
    docs = [path for path in root.glob("docs/**/*.md") if "_build" not in path.parts]
    pages = [root / "README.md", root / "benchmarks/results/README.md", *sorted(docs)]
    return [page for page in pages if MARKER.search(page.read_text(encoding="utf-8"))]


def write_pages(published: Published, pages: Sequence[Path]) -> None:
    """Write the tables of pages anew.

    Raises:
        SystemExit: If a place is not whole, or its name is not known.
    """
    for page in pages:
        text = page.read_text(encoding="utf-8")
        names = [name for _, name, _ in BLOCK.findall(text)]
        if len(MARKER.findall(text)) != 2 * len(names) or not {*names} <= {*BLOCKS}:
            raise SystemExit(
                f"{page}: expected places <!-- results: NAME --> ... {END} with names "
                f"among {', '.join(BLOCKS)}; got {', '.join(names)}."
            )
        new = BLOCK.sub(
            lambda block: "\n".join(
                [block[1].rstrip(), *BLOCKS[block[2]](published), END]
            ),
            text,
        )
        with write_atomically(page) as temporary:
            temporary.write_text(new, encoding="utf-8")


# Texts --------------------------------------------------------------------------------


def table(head: Sequence[object], lines: Iterable[Iterable[object]]) -> Lines:
    """Return a table in Markdown."""
    first, *others = (f"| {' | '.join(map(str, line))} |" for line in (head, *lines))
    return [first, f"|{'|'.join([' --- '] * len(head))}|", *others]


def number_text(values: pd.Series, form: str) -> str:
    """Return the mean over repetitions and, of several, the standard deviation.

    One -inf makes the mean -inf, without a spread.
    """
    average = float(values.mean())
    if len(values) < 2 or not np.isfinite(average):
        return f"{average:{form}}"
    return f"{average:{form}} ± {values.std():{form.lstrip('+')}}"


def lpp_text(rows: pd.DataFrame) -> str:
    """Return the LPP over repetitions, and whether a coupling has not converged."""
    text = number_text(rows["lpp_z"], ".2f")
    return text + ("" if rows["converged"].all() else " (not converged)")


def acauc_text(rows: pd.DataFrame) -> str:
    """Return the ACAUC over repetitions."""
    return number_text(rows["acauc"], "+.3f")


def both_texts(rows: pd.DataFrame) -> str:
    """Return the mean LPP with the mean ACAUC in brackets."""
    return f"{mean(rows):.2f} ({mean(rows, 'acauc'):+.2f})"


def entry(
    rows: pd.DataFrame, text: Callable[[pd.DataFrame], str], out_of: int | None = None
) -> str:
    """Return scores as text, with what failed.

    Args:
        rows: One a repetition.
        text: Makes a text of those that were finished.
        out_of: The number of repetitions of what it stands beside. If there are fewer
            rows, the entry says of how many it is.
    """
    scored = finished(rows)
    if not len(scored):
        return "failed" if len(rows) else MISSING
    failed = len(rows) - len(scored)
    fewer = f" [{len(rows)}]" if out_of is not None and len(rows) < out_of else ""
    return (
        text(scored) + fewer + (f" ({failed} of {len(rows)} failed)" if failed else "")
    )


# All suites, and all tasks of `main` --------------------------------------------------


def _overview(published: Published) -> Lines:
    lines = []
    for name, suite in published.suites.items():
        rows = published.rows[name]
        if name == "smoke":  # its numbers mean nothing
            continue
        there = {*rows.index}
        runs: dict[str, dict[int, set[Cell]]] = {}
        for cell in suite.cells:
            of_place = runs.setdefault(f"{cell.task} {cell.variant}".strip(), {})
            of_place.setdefault(cell.repetition, set()).add(cell)
        whole = {
            place: sum(run <= there for run in parts.values())
            for place, parts in runs.items()
        }
        stand_ins = rows[rows["stand_in"] == True]  # noqa: E712
        places = (stand_ins["task"] + " " + stand_ins["variant"]).str.strip().unique()
        lines.append(
            [
                f"[{name}]({name}/report.md)" if there else name,
                *((rows["status"] == what).sum() for what in ("finished", "failed")),
                len({*suite.cells} - there),
                ", ".join(
                    f"{place} {n}/{len(runs[place])}" for place, n in whole.items()
                ),
                ", ".join(places),
            ]
        )
    head = ("suite", "finished", "failed", "not run", "complete repetitions")
    return table((*head, "stand-ins among what was run"), lines)


def _tasks(published: Published) -> Lines:
    run = {*published.rows["main"]["task"]}
    return [task for task in LETTERS if task in run]


def _all_tasks(
    text: Callable[[pd.DataFrame], str], *, with_settings: Sequence[str]
) -> Callable[[Published], Lines]:
    """Return what writes a table of methods and tasks, with other settings of some."""

    def lines_of(published: Published) -> Lines:
        tasks = _tasks(published)
        columns = [
            {name: published.select(name, task=task) for name in METHODS}
            for task in tasks
        ]
        counts = [num_repetitions(column.values()) for column in columns]
        best = [
            _best(column, count) if text is lpp_text else None
            for column, count in zip(columns, counts, strict=True)
        ]
        lines = [["repetitions", *map(str, counts)]]
        for name in METHODS:
            if any(len(column[name]) for column in columns):
                entries = [
                    entry(column[name], text, count)
                    for column, count in zip(columns, counts, strict=True)
                ]
                marked = [
                    f"**{one}**" if name == first else one
                    for one, first in zip(entries, best, strict=True)
                ]
                lines.append([name, *marked])
        # They do not compete, or one of four would be chosen by the reported score.
        others = FIXED._replace(tau=0.9), PAPER, PAPER._replace(tau=0.9)
        for name in with_settings:
            for setting in others:
                entries = [
                    entry(
                        published.select(name, task=task, setting=setting), text, count
                    )
                    for task, count in zip(tasks, counts, strict=True)
                ]
                lines.append([f"{name} ({setting})", *entries])
        return table(("", *map(published.name, tasks)), lines)

    return lines_of


def _best(rows: Mapping[str, pd.DataFrame], repetitions: int) -> str | None:
    """Return the method with the best mean among those of all repetitions."""
    known = {
        name: score
        for name, part in rows.items()
        if name != "SBI" and len(finished(part)) == repetitions
        if (score := mean(part)) is not None and score > -math.inf
    }
    return max(known, key=known.__getitem__, default=None)


def _by_size(published: Published) -> Lines:
    sizes = sorted({*published.main["n_calibration"]} - {0})
    lines = []
    for task in _tasks(published):
        parts = [
            *(published.select(name, task=task) for name in ("prior", "OT-only")),
            *(published.select("RoPE", task=task, size=size) for size in sizes),
            published.select("SBI", task=task),
        ]
        count = num_repetitions(parts)
        entries = [entry(part, both_texts, count) for part in parts]
        lines.append([published.name(task), *entries])
    return table(("", "prior", "OT-only", *(f"{n} pairs" for n in sizes), "SBI"), lines)


# A method against the best other ------------------------------------------------------


def _compared(published: Published, method: str = STACK) -> list[Comparison]:
    return compare(finished(published.main), method)


def _best_others(published: Published, compared: Iterable[Comparison]) -> Lines:
    """Return a table with the best other method of each task and number of pairs."""
    head = ("task", "pairs", "repetitions", "stack", "ACAUC", "best other")
    head += ("its LPP", "difference", "s", "calls")
    rows = finished(published.main)
    lines = []
    for one in compared:
        best = one.best()
        assert best is not None
        gap = one.gaps[best]
        others = rows[
            (rows["method"] == best)
            & (rows["task"] == one.task)
            & rows["n_calibration"].isin([0, one.size])
            & rows["repetition"].isin(gap.index)
        ]
        own = one.rows[one.rows["repetition"].isin(gap.index)]
        width = half_width(gap.to_numpy())
        lines.append(
            [
                published.name(one.task),
                *(one.size, len(gap)),
                f"{own['lpp_z'].mean():.2f}",
                f"{own['acauc'].mean():+.3f}",
                best,
                f"{others['lpp_z'].mean():.2f}",
                f"{gap.mean():+.2f}" + (f" ± {width:.2f}" if width < np.inf else ""),
                f"{_seconds(own):.0f}",
                f"{_calls(own, rows):,.0f}",
            ]
        )
    return table(head, lines)


def _seconds(rows: pd.DataFrame) -> float:
    return float((rows["seconds_train"] + rows["seconds_couple"]).mean())


def _calls(part: pd.DataFrame, rows: pd.DataFrame) -> float:
    """Return the simulations beyond those of the NPE that methods share."""
    shared = rows[(rows["method"] == "NPE") & rows["task"].isin(part["task"])]
    base = shared["num_simulations"].max() if len(shared) else 0
    return max(0.0, float(part["num_simulations"].mean()) - float(base))


def _not_the_best(published: Published) -> Lines:
    lost = [
        one
        for one in _compared(published)
        if one.size <= MAX_PAIRS and not one.is_near(str(one.best()))
    ]
    return _best_others(published, lost)


def _goals(published: Published) -> Lines:
    """Say how often each goal was met, and where it was not."""
    few = [one for one in _compared(published) if one.size <= MAX_PAIRS]
    near, above = Comparison.is_near, Comparison.is_above
    goals = {
        "best, or within 0.1 nats of the best": (near, {}),
        "best, or within 0.1 nats of the best of those that see no more data": (
            near,
            {"unlabelled": False},
        ),
        "better than the best other beyond the interval over repetitions": (above, {}),
        "better beyond that interval than the best of those that are not of this "
        "package": (above, {"ours": False}),
    }
    lines = [f"With up to {MAX_PAIRS} pairs the stack is"]
    for goal, (holds, among) in goals.items():
        met = {
            f"{one.task} ({one.size})": holds(one, best)
            for one in few
            if (best := one.best(**among)) is not None
        }
        lines.append(_counted(goal, met))
    basics = {
        f"{one.task} ({one.size})": all(one.is_near(name) for name in ("prior", "NPE"))
        for one in few
        if {"prior", "NPE"} <= {*one.gaps}
    }
    lines.append(_counted("not more than 0.1 nats below the prior or NPE", basics))
    acauc = np.mean([one.rows["acauc"].abs().mean() for one in few])
    rows = finished(published.main)
    sbi = rows[(rows["method"] == "SBI") & rows["task"].isin([o.task for o in few])]
    of_sbi = sbi["acauc"].abs().groupby(sbi["task"]).mean().mean()
    text = (
        f"- of a mean |ACAUC| of {acauc:.3f} over tasks, pairs and repetitions (aimed"
    )
    return [*lines, f"{text} at 0.03; SBI has {of_sbi:.3f} on these tasks)"]


def _counted(goal: str, met: Mapping[str, bool]) -> str:
    missed = [name for name, is_met in met.items() if not is_met]
    named = f"; not {', '.join(missed)}" if 0 < len(missed) <= len(met) / 2 else ""
    return f"- {goal}: {sum(met.values())} of {len(met)}{named}"


def _against_candidates(published: Published) -> Lines:
    """Count how near the stacks of `stacking` are to the best of their candidates."""
    found = against_candidates(Results(published.folder / "stacking"))
    lines = [
        [
            size,
            len(part),
            (part["best"] >= -0.1).sum(),
            (part["basics"] >= -0.1).sum(),
            (part["held_out"].abs() <= 2).sum(),
        ]
        for size, part in found.groupby("size")
    ]
    head = ("pairs", "stacks", "within 0.1 of the best candidate")
    head += ("not 0.1 below prior or NPE", "within two errors of the held-out score")
    return table(head, lines)


def _costs(published: Published) -> Lines:
    """Return seconds and calls of all methods, at 50 pairs."""
    rows = finished(published.main)
    some = rows[rows["n_calibration"].isin([0, SIZE])]
    tasks = [task for task in LETTERS if task in {*some["task"]}]
    lines = []
    for name in METHODS:
        of_method = some[some["method"] == name]
        if name not in ("prior", "SBI") and len(of_method):
            parts = [of_method[of_method["task"] == task] for task in tasks]
            entries = [
                f"{_seconds(part):.0f} / {_calls(part, rows):,.0f}"
                if len(part)
                else MISSING
                for part in parts
            ]
            lines.append([name, *entries])
    return table((f"{SIZE} pairs: s / calls", *map(published.name, tasks)), lines)


def _losses(published: Published) -> Lines:
    """Return where another method is better than RoPE."""
    lines = []
    for one in _compared(published, "RoPE"):
        best = one.best()
        if best is None or one.gap(best) >= 0:
            continue
        below = [
            f"{one.gap(name):.2f}" if name in one.gaps and one.gap(name) < 0 else ""
            for name in ("prior", "OT-only")
        ]
        lpp = f"{one.rows['lpp_z'].mean():.2f}"
        last = f"{one.gap(best):.2f} {best}"
        lines.append([published.name(one.task), one.size, lpp, *below, last])
    head = ("task", "pairs", "RoPE", "to the prior", "to OT-only", "to the best other")
    return table(head, lines)


# The other suites ---------------------------------------------------------------------


def _grid(
    suite: str,
    *,
    column: Callable[[Cell], float],
    line: Callable[[Cell], str],
    text: Callable[[Published, pd.DataFrame], str] = lambda _, rows: both_texts(rows),
    beside: Sequence[str] = (),
    methods: Sequence[str] = ("RoPE",),
    all_sizes: bool = False,
) -> Callable[[Published], Lines]:
    """Return what writes a table of a suite.

    Args:
        suite: Its name.
        column: What differs from column to column.
        line: What differs from line to line, besides the task.
        text: Makes an entry.
        beside: Methods whose LPP on the same data stands in the name of a line.
        methods: Those that are shown.
        all_sizes: Whether to show all numbers of calibration pairs.
    """

    def lines_of(published: Published) -> Lines:
        rows = published.rows[suite]
        counts = rows.groupby(WHERE)["repetition"].nunique()
        rows = rows[rows["method"].isin(methods)]
        rows = rows[all_sizes | (rows["n_calibration"] == SIZE)]
        names = {}
        for where in rows[WHERE].drop_duplicates().itertuples(index=False):
            lpps = [
                f"{name} {entry(published.select(name, suite=suite, **same), lpp_text)}"
                for same in [where._asdict()]
                for name in beside
            ]
            names[tuple(where)] = f" ({', '.join(lpps)})" if lpps else ""
        labels = [
            f"{published.name(cell.task, suite=suite)}, {line(cell)}"
            + names[cell.task, cell.variant, cell.options]
            for cell in rows.index
        ]
        entries = {
            place: entry(
                part,
                lambda scored: text(published, scored),
                counts[tuple(part[WHERE].iloc[0])],
            )
            for place, part in rows.groupby([labels, rows.index.map(column)])
        }
        columns = sorted({column for _, column in entries})
        lines = [
            [label, *(entries.get((label, column), MISSING) for column in columns)]
            for label in dict.fromkeys(labels)
        ]
        return table(("", *(f"{column:g}" for column in columns)), lines)

    return lines_of


def _above_npe(published: Published, rows: pd.DataFrame) -> str:
    npe = published.select("NPE", suite="wellspecified", task=rows["task"].iloc[0])
    scores = finished(npe).set_index("repetition")["lpp_z"]
    return f"{(rows.set_index('repetition')['lpp_z'] - scores).mean():+.2f}"


def _option(cell: Cell, name: str) -> float | None:
    return json.loads(cell.options).get(name)


def _weight(cell: Cell) -> str:
    weight = _option(cell, "misspecification_weight")
    return "prior shifted" if weight is None else f"weight {weight:g}"


def _unit(cell: Cell) -> str:
    unit = "embedding" if cell.cost_scale == "none" else "median distance"
    return f"in units of the {unit}"


# README -------------------------------------------------------------------------------

OF_README = {
    "prior": "prior",
    "NPE": "NPE as it was",
    "fine-tuned NPE (averaged)": "fine-tuned NPE, averaged",
    "FMCPE (embedding)": "FMCPE (embedding)",
    "FRISBI (distilled)": "FRISBI (distilled)",
    "RoPE": "RoPE",
    STACK: "**`stack`**",
}


def _readme(published: Published) -> Lines:
    rows = published.main[published.main["task"] == "light_tunnel_sensors"]
    lines = []
    for method, name in OF_README.items():
        of_method = rows[rows["method"] == method]
        parts = [of_method[of_method["n_calibration"].isin([0, n])] for n in FEW]
        known = finished(parts[1])["acauc"]
        acauc = f"{known.mean():+.3f}" if len(known) else MISSING
        lines.append([name, *map(_with_interval, parts), acauc])
    return [
        "LPP is the mean log density of the true parameters, in standard deviations of",
        "the prior: higher is better. ± is its 95 % interval over repetitions, whose",
        "number is in brackets (of one, over observations). ACAUC is 0 for calibrated",
        "posteriors, positive for over-confident and negative for too wide.",
        "",
        *table(("", *(f"{n} labels" for n in FEW), "ACAUC, 50 labels"), lines),
        "",
        "[All tasks, all methods](benchmarks/results/README.md), also where another is "
        "better.",
    ]


def _with_interval(rows: pd.DataFrame) -> str:
    scored = finished(rows)
    failed = len(rows) - len(scored)
    if not len(scored):
        return "failed" if failed else MISSING
    width = half_width(scored["lpp_z"].to_numpy(dtype=float))
    if np.isinf(width):
        width = 1.96 * float(scored["lpp_standard_error"].mean())
    count = f"{len(scored)}; {failed} failed" if failed else f"{len(scored)}"
    return f"{scored['lpp_z'].mean():.2f} ± {width:.2f} ({count})"


# Pages of docs ------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Excerpt:
    """A table of mean scores, each chosen by what its line and its column say.

    Attributes:
        lines: The name of each line, and what it chooses.
        columns: The name of each column, and what it chooses.
        chosen: What all of them choose.
        score: The LPP or the ACAUC.
        sizes: The numbers of pairs in an entry.
    """

    lines: Mapping[str, Fields]
    columns: Mapping[str, Fields]
    chosen: Fields = field(default_factory=dict)
    score: str = "lpp_z"
    sizes: Sequence[int] = (SIZE,)

    def __call__(self, published: Published) -> Lines:
        """Return the table in Markdown."""
        usual = num_repetitions([published.rows["main"]])
        lines = []
        for name, line in self.lines.items():
            entries = []
            for column in self.columns.values():
                fields = self.chosen | column | line
                parts = [published.select(**({"size": n} | fields)) for n in self.sizes]
                # Once, if it needs no pairs or was not run at all.
                if all(part.index.equals(parts[0].index) for part in parts):
                    parts = parts[:1]
                texts = [entry(part, self._text, usual) for part in parts]
                entries.append(" / ".join(texts))
            lines.append([name, *entries])
        return table(("", *self.columns), lines)

    def _text(self, rows: pd.DataFrame) -> str:
        # Without the sign of -0.00.
        return f"{round(mean(rows, self.score) or 0.0, 2) + 0.0:.2f}"


def _methods(*names: str) -> dict[str, Fields]:
    return {name: {"method": name} for name in names}


OF_EACH_SIZE = {f"{size} pairs": {"size": size} for size in (*FEW, 1000)}
SENSORS = {"task": "light_tunnel_sensors"}
LINEAR = {"task": "linear_gaussian"}
IMAGES = {"task": "light_tunnel"}
TASKS = {
    "cs": {"task": "cs"},
    "sir": {"task": "sir"},
    "pendulum": {"task": "pendulum"},
    "hemodynamics": {"task": "hemodynamics"},
    "wind tunnel (stand-in)": {"task": "wind_tunnel"},
    "sensors (real)": SENSORS,
}
BLOCKS: dict[str, Callable[[Published], Lines]] = {
    "readme": _readme,
    "what-was-run": _overview,
    "all-tasks": _all_tasks(lpp_text, with_settings=("RoPE",)),
    "lpp": _all_tasks(lpp_text, with_settings=("OT-only", "RoPE")),
    "acauc": _all_tasks(acauc_text, with_settings=("OT-only", "RoPE")),
    "stack": lambda published: _best_others(published, _compared(published)),
    "not-the-best": _not_the_best,
    "goals": _goals,
    "candidates": _against_candidates,
    "costs": _costs,
    "rope-by-size": _by_size,
    "rope-losses": _losses,
    "gamma": _grid(
        "gamma",
        column=lambda cell: cell.gamma or 0.0,
        line=_unit,
        beside=("prior", "SBI"),
    ),
    "tau": _grid(
        "tau",
        column=lambda cell: cell.tau or 0.0,
        line=_weight,
        beside=("prior", "NPE"),
    ),
    "wellspecified": _grid(
        "wellspecified",
        column=lambda cell: cell.n_calibration,
        line=lambda cell: f"tau {cell.tau:g}",
        beside=("prior", "NPE"),
        text=_above_npe,
        all_sizes=True,
    ),
    "noisy-labels": _grid(
        "labels",
        column=lambda cell: 100 * (_option(cell, "label_noise") or 0.0),
        line=lambda cell: cell.method,
        text=lambda _, rows: lpp_text(rows),
        methods=methods_where(lambda entry: entry.pairs),
    ),
    "stack-and-others": Excerpt(
        lines=_methods("prior", "NPE", "OT-only", "NNPE", "RVNP", "RVNP (offset)")
        | {"RNPE": {"method": "RNPE", "suite": "extras"}}
        | _methods("fine-tuned NPE", "fine-tuned NPE (averaged)", "RoPE")
        | _methods("discrepancy", "discrepancy, fine-tuned", STACK),
        columns=TASKS,
    ),
    "labels": Excerpt(
        lines=_methods("RoPE", "J-NPE", "fine-tuned NPE", "fine-tuned NPE (averaged)")
        | _methods("discrepancy", "discrepancy, fine-tuned", STACK),
        columns=OF_EACH_SIZE,
        chosen=SENSORS,
    ),
    "labels-of-a-stack": Excerpt(
        lines={
            "light tunnel's sensors, real measurements": SENSORS,
            "spread of an epidemic (`sir`)": {"task": "sir"},
            "pendulum with friction": {"task": "pendulum"},
        },
        columns={"NPE": {"method": "NPE"}}
        | {f"{n} pairs": {"method": STACK, "size": n} for n in FEW},
    ),
    "images": Excerpt(
        lines=_methods("RoPE", "FRISBI", "FRISBI (distilled)", "FMCPE (embedding)")
        | _methods("J-NPE", "fine-tuned NPE", "fine-tuned NPE (averaged)")
        | _methods("discrepancy", "discrepancy (tuned)", "discrepancy, fine-tuned")
        | _methods(STACK),
        columns=OF_EACH_SIZE,
        chosen=IMAGES,
    ),
    "calibration": Excerpt(
        lines=TASKS | {"images (stand-in)": IMAGES},
        columns=_methods("SBI", "NPE", "RoPE", "discrepancy, fine-tuned", STACK),
        score="acauc",
        sizes=FEW,
    ),
    "rivals": Excerpt(
        lines=_methods("FMCPE", "FMCPE (embedding)", "FRISBI", "FRISBI (distilled)")
        | _methods("RoPE", STACK),
        columns={name: task for name, task in TASKS.items() if name != "hemodynamics"},
        sizes=FEW,
    ),
    "failures": Excerpt(
        lines={
            "curved": {"variant": "curved"},
            "heavy tails": {"variant": "heavy_tails"},
        },
        columns=_methods("RoPE", "fine-tuned NPE", "discrepancy (input)", STACK),
        chosen=LINEAR | {"suite": "failures"},
        sizes=FEW,
    ),
    "shift": Excerpt(
        lines={"sensors (real)": SENSORS | {"variant": "sensor_settings"}},
        columns=_methods("prior", "NPE", "OT-only", "RoPE", "fine-tuned NPE")
        | _methods("discrepancy", STACK),
        chosen={"suite": "shift"},
        sizes=FEW,
    ),
    "pairs-from-the-middle": Excerpt(
        lines={
            "sensors (real)": SENSORS | {"suite": "noniid"},
            "pendulum": {"task": "pendulum", "suite": "noniid"},
            "linear_gaussian": LINEAR | {"suite": "failures"},
        },
        columns=_methods("prior", "RoPE", "fine-tuned NPE", STACK, GIVEN_PRIOR_STACK),
        chosen={"variant": "biased_calibration"},
        sizes=FEW,
    ),
    "dimension": Excerpt(
        lines=_methods("prior", "SBI", "RoPE", "tuning-only", "fine-tuned NPE")
        | _methods("discrepancy", STACK),
        columns={
            f"{dim} parameters": {"options": f'{{"dim": {dim}}}'}
            for dim in (2, 5, 10, 25)
        },
        chosen=LINEAR | {"suite": "dimension"},
    ),
}
