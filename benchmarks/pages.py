"""Tables of README and of pages of docs.

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

from benchmarks.methods import GIVEN_PRIOR_STACK, METHODS, OBSERVED_STACK, STACK
from benchmarks.published import (
    LETTERS,
    MOST,
    NEAR,
    PAPER,
    SIZE,
    Comparison,
    Published,
    compare,
    finished,
    half_width,
    mean,
)
from sbi_rope.utils.files import write_atomically

END = "<!-- /results -->"
BLOCK = re.compile(rf"(<!-- results: ([\w-]+) -->\n)(.*?){END}", re.DOTALL)
# What begins or ends a block, also one that is not whole.
MARKER = re.compile(r"<!-- /?results")
MISSING = "-"
# Numbers of pairs that are shown side by side.
FEW = (10, 50, 200)
# What a stack must not be below.
BASICS = {"prior", "NPE", "Regression"}
# Variants of the suite `stacking`.
WRONG = {
    "": "the simulator",
    "prior_shift": "the prior, too",
    "other_cruises": "the pairs: other cruises",
    "well_specified": "nothing",
}
Lines = list[str]
# What `Published.select` is asked for.
Fields = dict[str, Any]


def pages_with_blocks(root: Path) -> list[Path]:
    """Return the pages of a project that have places for tables."""
    docs = [path for path in root.glob("docs/**/*.md") if "_build" not in path.parts]
    pages = [root / "README.md", *sorted(docs)]
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


def entry(rows: pd.DataFrame, out_of: int) -> str:
    """Return the mean LPP over repetitions, and what failed or has not converged.

    If there are fewer than ``out_of`` rows, the entry says how many.
    """
    scored = finished(rows)
    if not len(scored):
        return "failed" if len(rows) else MISSING
    failed = len(rows) - len(scored)
    # Without the sign of -0.00.
    text = f"{round(mean(rows) or 0.0, 2) + 0.0:.2f}"
    text += "" if scored["converged"].all() else " (not converged)"
    text += f" [{len(rows)}]" if len(rows) < out_of else ""
    return text + (f" ({failed} of {len(rows)} failed)" if failed else "")


# What was run, and all tasks of `main` ------------------------------------------------


def _overview(published: Published) -> Lines:
    """Count cells by suite, and name what failed and what was not run."""
    lines, complete = [], []
    for name, suite in published.suites.items():
        # Others are former runs, and the numbers of `smoke` mean nothing.
        if name == "smoke" or not any(cell.method == STACK for cell in suite.cells):
            continue
        rows = published.rows[name]
        rows = rows[rows["suite"] == name]
        others = {
            "failed": _counts(rows["method"][rows["status"] == "failed"]),
            "not run": _counts(cell.method for cell in {*suite.cells} - {*rows.index}),
        }
        texts = [f"; {what}: {counts}" for what, counts in others.items() if counts]
        cells = f"{len(suite.cells)} cells"
        if texts:
            done = (rows["status"] == "finished").sum()
            lines.append(f"- {name}: {done} of {cells}{''.join(texts)}")
        else:
            complete.append(f"{name} ({cells})")
    return [*lines, f"- complete: {', '.join(complete) or 'none'}"]


def _counts(names: Iterable[str]) -> str:
    """Return how often there is each name."""
    counts = sorted(Counter(names).items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{name} {count}" for name, count in counts)


def _scores(published: Published) -> Lines:
    r"""Return the LPP of all methods on all tasks; the best are bold.

    The last columns are the mean \|ACAUC\| over tasks and repetitions, and the median
    over tasks of the seconds beside NPE's own training.
    """
    usual = published.num_repetitions
    rows = {name: published.select(name) for name in METHODS}
    # It does not compete, or one of two would be chosen by the reported score.
    rows[f"RoPE ({PAPER})"] = published.select("RoPE", setting=PAPER)
    # Others are in the tables of `earlier` only.
    of_main = {name: part[part["suite"] == "main"] for name, part in rows.items()}
    rows = {name: part for name, part in of_main.items() if len(part)}
    columns = {}
    for task in LETTERS:
        parts = {name: part[part["task"] == task] for name, part in rows.items()}
        columns[task] = {name: entry(part, usual) for name, part in parts.items()}
        if best := _best(parts, usual):
            columns[task][best] = f"**{columns[task][best]}**"
    lines = []
    for name, part in rows.items():
        known = finished(part)
        by_task = (known["seconds_train"] + known["seconds_couple"]).groupby(
            known["task"]
        )
        costs = f"{known['acauc'].abs().mean():.3f}", f"{by_task.mean().median():.0f}"
        lines.append([name, *(columns[task][name] for task in LETTERS), *costs])
    head = ("", *map(published.name, LETTERS), "\\|ACAUC\\|", "seconds")
    return table(head, lines)


def _best(rows: Mapping[str, pd.DataFrame], repetitions: int) -> str | None:
    """Return the method with the best mean among those of all repetitions."""
    known = {
        name: score
        for name, part in rows.items()
        if name in METHODS and name != "SBI" and len(finished(part)) == repetitions
        if (score := mean(part)) is not None and score > -math.inf
    }
    return max(known, key=known.__getitem__, default=None)


def _of_the_stack(published: Published) -> Lines:
    """Return what the stack reaches and costs with more and more pairs, by task."""
    lines = []
    for task in LETTERS:

        def of_sizes(method: str, column: str, form: str, task: str = task) -> str:
            parts = [published.select(method, task=task, size=n) for n in FEW]
            means = [mean(part, column) for part in parts]
            texts = [MISSING if one is None else f"{one:{form}}" for one in means]
            return MISSING if {*texts} == {MISSING} else " / ".join(texts)

        lines.append(
            [
                published.name(task),
                of_sizes(STACK, "lpp_z", ".2f"),
                of_sizes(OBSERVED_STACK, "lpp_z", ".2f"),
                of_sizes(STACK, "acauc", "+.3f"),
                of_sizes(STACK, "seconds_train", ".0f"),
                f"{mean(published.select('NPE', task=task), 'seconds_npe') or 0:.0f}",
            ]
        )
    head = ("LPP", "LPP with x_o", "ACAUC", "seconds", "seconds of NPE's training")
    return table(("", *head), lines)


# A method against the best other ------------------------------------------------------


def _not_the_best(published: Published) -> Lines:
    """Return where another method is above the stack by more than is near.

    Methods that were not run again, †, are among them.
    """
    lines = []
    earlier = {cell.method for cell in published.suites["earlier"].cells}
    earlier -= {cell.method for cell in published.suites["main"].cells}
    for one in compare(finished(published.main)):
        best = one.best()
        assert best is not None
        if one.is_near(best):
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
                best + " †" * (best in earlier),
                f"{lpp - gap.mean():.2f}",
                f"{gap.mean():+.2f}" + (f" ± {width:.2f}" if width < np.inf else ""),
            ]
        )
    head = ("task", "pairs", "repetitions", "stack", "ACAUC", "best other")
    return table((*head, "its LPP", "difference"), lines)


def _goals(published: Published) -> Lines:
    """Say how often each goal was met, and where it was not."""
    rows = finished(published.main)
    cells, observed = compare(rows), compare(rows, OBSERVED_STACK)
    stacks, sbi = (rows[rows["method"] == name] for name in (STACK, "SBI"))
    means = stacks.groupby(["task", "n_calibration"])[["seconds_train", "seconds_npe"]]
    seconds = means.mean().query("seconds_train >= seconds_npe").index
    near = Comparison.is_near
    unit = "best, or within 0.1 nats of the best"
    return [
        "The stack is",
        _counted(unit, cells, near),
        _counted(
            f"{unit} of those that see no more data", cells, near, unlabelled=False
        ),
        _counted(
            "not more than 0.1 nats below the prior, NPE or Regression",
            cells,
            lambda one, _: all(one.is_near(name) for name in BASICS & {*one.gaps}),
        ),
        _counted(
            "trained in less time than NPE",
            cells,
            lambda one, _: (one.task, one.size) not in seconds,
        ),
        f"- of a mean |ACAUC| of {_acauc(stacks)} (aimed at 0.03; SBI: {_acauc(sbi)})",
        _counted(f"with x_o {unit}", observed, near),
    ]


def _counted(
    goal: str,
    cells: Sequence[Comparison],
    holds: Callable[[Comparison, str], bool],
    **among: bool,
) -> str:
    """Count where something holds against the best other; name the others, if few."""
    met = {
        f"{one.task} ({one.size})": holds(one, best)
        for one in cells
        if (best := one.best(**among)) is not None
    }
    missed = [name for name, is_met in met.items() if not is_met]
    named = f"; not {', '.join(missed)}" if 0 < len(missed) <= len(met) / 2 else ""
    return f"- {goal}: {sum(met.values())} of {len(met)}{named}"


def _acauc(rows: pd.DataFrame) -> str:
    """Return the mean |ACAUC|, in which all tasks count the same."""
    return f"{rows['acauc'].abs().groupby(rows['task']).mean().mean():.3f}"


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
    lines = []
    for variant, name in WRONG.items():
        of_variant = counted[rows["variant"] == variant]
        sums = of_variant.groupby(rows["n_calibration"].replace(*MOST)).sum()
        columns = [" / ".join(map(str, column)) for column in sums.to_numpy().T]
        if len(sums):
            lines.append([name, *columns])
    head = ("stacks", "within 0.1 of the best candidate")
    head += ("not 0.1 below prior or NPE", "within two errors of the held-out score")
    return table(("what is wrong", *head), lines)


# README -------------------------------------------------------------------------------

OF_README = {
    "prior": "prior",
    "NPE": "NPE as it was",
    "fine-tuned NPE (averaged)": "fine-tuned NPE, averaged",
    "FMCPE": "FMCPE",
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
        "[All tasks, all methods](docs/background/benchmark.md), also where another is "
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
        usual = published.num_repetitions
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
        return " / ".join(entry(part, usual) for part in parts)


def _methods(*names: str) -> dict[str, Fields]:
    return {name: {"method": name} for name in names}


SENSORS = {"task": "light_tunnel_sensors"}
LINEAR = {"task": "linear_gaussian"}
FAILURES = LINEAR | {"suite": "failures"}
MIDDLE = {"variant": "biased_calibration"}
RIGHT = {"suite": "wellspecified", "variant": "well_specified"}
NOISY: Fields = {"suite": "labels", "size": SIZE, "options": '{"label_noise": 0.1}'}
BLOCKS: dict[str, Callable[[Published], Lines]] = {
    "readme": _readme,
    "scores": _scores,
    "of-the-stack": _of_the_stack,
    "not-the-best": _not_the_best,
    "goals": _goals,
    "candidates": _against_candidates,
    "what-was-run": _overview,
    "labels-of-a-stack": Excerpt(
        lines={
            "light tunnel's sensors, real measurements": SENSORS,
            "spread of an epidemic (`sir`)": {"task": "sir"},
            "pendulum with friction": {"task": "pendulum"},
        },
        columns={"NPE": {"method": "NPE"}}
        | {f"{n} pairs": {"method": STACK, "size": n} for n in FEW},
    ),
    "hard": Excerpt(
        lines={
            "curved error": FAILURES | {"variant": "curved"},
            "heavy tails": FAILURES | {"variant": "heavy_tails"},
            "other settings, sensors (real)": SENSORS
            | {"suite": "shift", "variant": "sensor_settings"},
            "nothing is wrong, pendulum": {"task": "pendulum"} | RIGHT,
            "nothing is wrong, sensors": SENSORS | RIGHT,
            "middle of the prior, linear_gaussian": FAILURES | MIDDLE,
            "the same, pendulum": {"task": "pendulum", "suite": "noniid"} | MIDDLE,
            "the same, sensors (real)": SENSORS | {"suite": "noniid"} | MIDDLE,
            "noise on 50 labels, pendulum": {"task": "pendulum"} | NOISY,
            "noise on 50 labels, sensors (real)": SENSORS | NOISY,
        }
        | {
            f"linear_gaussian, {dim} parameters, 50 pairs": LINEAR
            | {"suite": "dimension", "size": SIZE, "options": f'{{"dim": {dim}}}'}
            for dim in (10, 25)
        },
        columns=_methods("prior", "NPE", "RoPE", "fine-tuned NPE")
        | _methods(STACK, GIVEN_PRIOR_STACK),
        sizes=FEW,
    ),
}
