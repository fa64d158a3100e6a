"""Tables of README, of the page of all results, and of pages of docs.

A page has a place for each of its tables,

    <!-- results: NAME -->
    <!-- /results -->

and `write_pages` writes them anew. All else on a page is written by hand.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.methods import GIVEN_PRIOR_STACK, METHODS, STACK
from benchmarks.published import (
    LETTERS,
    MAX_PAIRS,
    NEAR,
    PAPER,
    SIZE,
    Comparison,
    Published,
    compare,
    finished,
    half_width,
    mean,
    num_repetitions,
)
from sbi_rope.utils.files import write_atomically

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


def costs_text(rows: pd.DataFrame) -> str:
    """Return seconds without the training of NPE, and simulations with those of NPE."""
    seconds = (rows["seconds_train"] + rows["seconds_couple"]).mean()
    return f"{seconds:.0f} / {rows['num_simulations'].mean():,.0f}"


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
    """Count cells by suite; what failed by method, what was not run by task."""
    lines = []
    for name, suite in published.suites.items():
        rows = published.rows[name]
        if name == "smoke":  # its numbers mean nothing
            continue
        missing = {*suite.cells} - {*rows.index}
        lines.append(
            [
                f"[{name}]({name}/{suite.x_axis}.png)" if len(rows) else name,
                (rows["status"] == "finished").sum(),
                _counts(rows["method"][rows["status"] == "failed"]),
                _counts(f"{cell.task} {cell.variant}".strip() for cell in missing),
            ]
        )
    return table(("suite", "finished", "failed", "not run"), lines)


def _counts(names: Iterable[str]) -> str:
    """Return how many names there are, and how often each of them."""
    counts = sorted(Counter(names).items(), key=lambda item: (-item[1], item[0]))
    each = ", ".join(f"{name} {count}" for name, count in counts)
    return f"{sum(count for _, count in counts)}" + (f": {each}" if each else "")


def _all_tasks(published: Published, text: Callable[[pd.DataFrame], str]) -> Lines:
    """Return a table of all methods on all tasks; the best LPPs are bold."""
    run = {*published.rows["main"]["task"]}
    tasks = [task for task in LETTERS if task in run]
    columns = [_column(published, task, text) for task in tasks]
    lines = [
        [name, *(column[name] for column in columns)]
        for name in columns[0]
        if any(column[name] != MISSING for column in columns)
    ]
    return table(("", *map(published.name, tasks)), lines)


def _column(
    published: Published, task: str, text: Callable[[pd.DataFrame], str]
) -> dict[str, str]:
    parts = {name: published.select(name, task=task) for name in METHODS}
    count = num_repetitions(parts.values())
    best = _best(parts, count) if text is lpp_text else None
    # It does not compete, or one of two would be chosen by the reported score.
    parts[f"RoPE ({PAPER})"] = published.select("RoPE", task=task, setting=PAPER)
    entries = {name: entry(part, text, count) for name, part in parts.items()}
    if best is not None:
        entries[best] = f"**{entries[best]}**"
    return {"repetitions": str(count), **entries}


def _best(rows: Mapping[str, pd.DataFrame], repetitions: int) -> str | None:
    """Return the method with the best mean among those of all repetitions."""
    known = {
        name: score
        for name, part in rows.items()
        if name != "SBI" and len(finished(part)) == repetitions
        if (score := mean(part)) is not None and score > -math.inf
    }
    return max(known, key=known.__getitem__, default=None)


# A method against the best other ------------------------------------------------------


def _not_the_best(published: Published) -> Lines:
    """Return where another method is above the stack by more than is near."""
    lines = []
    for one in compare(finished(published.main)):
        best = one.best()
        assert best is not None
        if one.size > MAX_PAIRS or one.is_near(best):
            continue
        gap = one.gaps[best]
        own = one.rows[one.rows["repetition"].isin(gap.index)]
        lpp, width = own["lpp_z"].mean(), half_width(gap.to_numpy())
        lines.append(
            [
                published.name(one.task),
                *(one.size, len(gap)),
                f"{lpp:.2f}",
                f"{own['acauc'].mean():+.3f}",
                best,
                f"{lpp - gap.mean():.2f}",
                f"{gap.mean():+.2f}" + (f" ± {width:.2f}" if width < np.inf else ""),
            ]
        )
    head = ("task", "pairs", "repetitions", "stack", "ACAUC", "best other")
    return table((*head, "its LPP", "difference"), lines)


def _goals(published: Published) -> Lines:
    """Say how often each goal was met, and where it was not."""
    rows = finished(published.main)
    few = [one for one in compare(rows) if one.size <= MAX_PAIRS]
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
    sbi = rows[(rows["method"] == "SBI") & rows["task"].isin([o.task for o in few])]
    of_sbi = sbi["acauc"].abs().groupby(sbi["task"]).mean().mean()
    lines.append(
        f"- of a mean |ACAUC| of {acauc:.3f} over tasks, pairs and repetitions (aimed "
        f"at 0.03; SBI has {of_sbi:.3f} on these tasks)"
    )
    return lines


def _counted(goal: str, met: Mapping[str, bool]) -> str:
    missed = [name for name, is_met in met.items() if not is_met]
    named = f"; not {', '.join(missed)}" if 0 < len(missed) <= len(met) / 2 else ""
    return f"- {goal}: {sum(met.values())} of {len(met)}{named}"


def _against_candidates(published: Published) -> Lines:
    """Count how near the stacks of `stacking` are to the best of their candidates."""
    rows = finished(published.rows["stacking"])
    lpp = rows["lpp_z"]
    counted = pd.DataFrame(
        {
            "stacks": 1,
            "best": lpp - rows["best_candidate"] >= -NEAR,
            "basics": lpp - rows["best_basic"] >= -NEAR,
            "held_out": (lpp - rows["held_out"]).abs() <= 2 * rows["held_out_error"],
        }
    )
    lines = counted.groupby(rows["n_calibration"]).sum().reset_index().to_numpy()
    head = ("pairs", "stacks", "within 0.1 of the best candidate")
    head += ("not 0.1 below prior or NPE", "within two errors of the held-out score")
    return table(head, lines)


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
    """A table of mean LPPs, each chosen by what its line and its column say.

    Attributes:
        lines: The name of each line, and what it chooses.
        columns: The name of each column, and what it chooses. A column without any
            result is left out.
        chosen: What all of them choose.
        sizes: The numbers of pairs in an entry.
    """

    lines: Mapping[str, Fields]
    columns: Mapping[str, Fields]
    chosen: Fields = field(default_factory=dict)
    sizes: Sequence[int] = (SIZE,)

    def __call__(self, published: Published) -> Lines:
        """Return the table in Markdown."""
        usual = num_repetitions([published.rows["main"]])
        columns = {}
        for name, column in self.columns.items():
            entries = [
                self._entry(published, self.chosen | column | line, usual)
                for line in self.lines.values()
            ]
            if {*entries} != {MISSING}:
                columns[name] = entries
        lines = zip(self.lines, *columns.values(), strict=True)
        return table(("", *columns), lines)

    def _entry(self, published: Published, fields: Fields, usual: int) -> str:
        parts = [published.select(**({"size": n} | fields)) for n in self.sizes]
        # Once, if it needs no pairs or was not run at all.
        if all(part.index.equals(parts[0].index) for part in parts):
            parts = parts[:1]
        return " / ".join(entry(part, _mean_text, usual) for part in parts)


def _mean_text(rows: pd.DataFrame) -> str:
    # Without the sign of -0.00.
    return f"{round(mean(rows) or 0.0, 2) + 0.0:.2f}"


def _methods(*names: str) -> dict[str, Fields]:
    return {name: {"method": name} for name in names}


SENSORS = {"task": "light_tunnel_sensors"}
LINEAR = {"task": "linear_gaussian"}
FAILURES = LINEAR | {"suite": "failures"}
MIDDLE = {"variant": "biased_calibration"}
TASKS = {
    "cs": {"task": "cs"},
    "sir": {"task": "sir"},
    "pendulum": {"task": "pendulum"},
    "hemodynamics": {"task": "hemodynamics"},
    "images (stand-in)": {"task": "light_tunnel"},
    "wind tunnel (stand-in)": {"task": "wind_tunnel"},
    "sensors (real)": SENSORS,
    "ocean colour (real)": {"task": "ocean_colour"},
    "near infrared (real)": {"task": "near_infrared"},
}
BLOCKS: dict[str, Callable[[Published], Lines]] = {
    "readme": _readme,
    "what-was-run": _overview,
    "lpp": lambda published: _all_tasks(published, lpp_text),
    "acauc": lambda published: _all_tasks(published, acauc_text),
    "not-the-best": _not_the_best,
    "goals": _goals,
    "candidates": _against_candidates,
    "costs": lambda published: _all_tasks(published, costs_text),
    "labels-of-a-stack": Excerpt(
        lines={
            "light tunnel's sensors, real measurements": SENSORS,
            "spread of an epidemic (`sir`)": {"task": "sir"},
            "pendulum with friction": {"task": "pendulum"},
        },
        columns={"NPE": {"method": "NPE"}}
        | {f"{n} pairs": {"method": STACK, "size": n} for n in FEW},
    ),
    "stack-and-others": Excerpt(
        lines=_methods("prior", "NPE", "OT-only", "RVNP", "J-NPE")
        | _methods("fine-tuned NPE (averaged)", "FMCPE (embedding)")
        | _methods("FRISBI (distilled)", "RoPE", "discrepancy, fine-tuned", STACK),
        columns=TASKS,
        sizes=FEW,
    ),
    "hard": Excerpt(
        lines={
            "curved error": FAILURES | {"variant": "curved"},
            "heavy tails": FAILURES | {"variant": "heavy_tails"},
            "other settings, sensors (real)": SENSORS
            | {"suite": "shift", "variant": "sensor_settings"},
            "middle of the prior, linear_gaussian": FAILURES | MIDDLE,
            "the same, pendulum": {"task": "pendulum", "suite": "noniid"} | MIDDLE,
            "the same, sensors (real)": SENSORS | {"suite": "noniid"} | MIDDLE,
        },
        columns=_methods("prior", "RoPE", "fine-tuned NPE", STACK, GIVEN_PRIOR_STACK),
        sizes=FEW,
    ),
    "dimension": Excerpt(
        lines=_methods("prior", "SBI", "RoPE", "fine-tuned NPE", STACK),
        columns={
            f"{dim} parameters": {"options": f'{{"dim": {dim}}}'}
            for dim in (2, 5, 10, 25)
        },
        chosen=LINEAR | {"suite": "dimension"},
    ),
}
