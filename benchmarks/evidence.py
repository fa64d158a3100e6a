"""The stack against all other methods, task by task, from the suite `main`.

Comparisons are between methods on the same data: a repetition counts where both
methods were run in it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import t as student

from benchmarks import figures
from benchmarks.methods import COUPLED_STACK, METHODS, STACK, STACKS, methods_where
from benchmarks.published import FIXED, LETTERS, MISSING, Published, Setting, table
from benchmarks.ranking import rank_figure, relative_ranks
from benchmarks.stacks import other_trainings
from benchmarks.table import Table, with_numbers

__all__ = [
    "CALIBRATED",
    "MAX_PAIRS",
    "Comparison",
    "compare",
    "draw_evidence",
    "evidence_lines",
    "finished_rows",
    "half_width",
    "lines_of_losses",
    "rows_of_main",
]

# The methods of the picture: what a user starts from, what is tuned on the pairs, the
# rivals of 2025 and 2026, the paper's method and the default of this package.
SHOWN = (
    "prior",
    "SBI",
    "NPE",
    "fine-tuned NPE",
    "fine-tuned NPE (averaged)",
    "FMCPE (embedding)",
    "FRISBI (distilled)",
    "RoPE",
    STACK,
)
# They are no methods, or need what others do not.
NO_RIVALS = ("SBI", *STACKS)
# They are of this package alone, and candidates of the stack.
OURS = methods_where(lambda entry: entry.ours)
# The goals, fixed beforehand: with up to so many pairs, in nats and ACAUC.
MAX_PAIRS, NEAR, CALIBRATED = 200, 0.1, 0.03
CURVES, RANKS = "methods.png", "ranks.png"
# Panels side by side, so that they can be read at the width of a page.
MAX_COLUMNS = 4
CONFIDENCE = 0.95
EXPLANATION = f"""\
A rank is among the methods that were run on the same data, with up to {MAX_PAIRS}
pairs: 0 is the best and 1 the last, which is also what failed. The picture has means
over tasks, with bootstrap intervals over these, and says where a method was not run on
all tasks.

"Best other" is the method with the highest LPP on the test set among all that were run
there, which no user can know. The difference is the stack's LPP minus its, on the same
data, with an interval of {CONFIDENCE:.0%} over repetitions (Student's t) where there
are several. A method that was run in fewer repetitions than the stack is compared in
these, and so are the LPPs of the row. The stack, RoPE, OT-only, FRISBI and averages of
networks are divided by their mass inside the prior, and fail where they have none. NPE
and the methods that are a single network, such as fine-tuned NPE, are not, which makes
their LPP lower where mass is outside. "s" are the seconds of training on one thread,
without the NPE that methods share, and with other work beside it. "Calls" are
simulations beyond those that NPE was trained on.
"""
OF_A_BATCH = f"""\
RoPE, OT-only, FRISBI and RVNP see the test observations, without their labels. The
stack above does not. This is what `{COUPLED_STACK}` has, which sees them too: it is
`stack(rope, x_o)`, with RVNP and couplings among its candidates.
"""


class Comparison(NamedTuple):
    """The stack on a task with so many pairs, and how far it is above all others."""

    task: str
    size: int
    stack: pd.DataFrame
    gaps: dict[str, pd.Series]

    @property
    def best(self) -> str:
        """The method that the stack is least above."""
        return min(self.gaps, key=self._mean_gap)

    @property
    def best_rival(self) -> str | None:
        """The same, without the methods of this package; None if there is no other."""
        rivals = (name for name in self.gaps if name not in OURS)
        return min(rivals, key=self._mean_gap, default=None)

    @property
    def best_equal(self) -> str | None:
        """The same, without methods that see observations if this stack does not."""
        sees = METHODS[self.stack["method"].iloc[0]].observations
        equals = (name for name in self.gaps if METHODS[name].observations <= sees)
        return min(equals, key=self._mean_gap, default=None)

    @property
    def gap(self) -> np.ndarray:
        """How far the stack is above the best, in the repetitions of both."""
        return self.gaps[self.best].to_numpy()

    def is_near(self, name: str) -> bool:
        """Tell whether it is above a method, or hardly below it."""
        return self._mean_gap(name) >= -NEAR

    def is_above(self, name: str) -> bool:
        """Tell whether it is above a method beyond the interval over repetitions."""
        gap = self.gaps[name].to_numpy()
        return bool(gap.mean() > half_width(gap))

    def _mean_gap(self, name: str) -> float:
        return float(self.gaps[name].mean())

    @property
    def above_basics(self) -> float | None:
        """How far the stack is above prior and NPE; None if one was not run."""
        if not {"prior", "NPE"} <= set(self.gaps):
            return None
        return min(map(self._mean_gap, ("prior", "NPE")))


def evidence_lines(published: Published) -> list[str]:
    """Return the section in Markdown, which links the pictures of `draw_evidence`."""
    rows = finished_rows(published)
    compared = compare(rows)
    if not compared:
        return ["Not run."]
    lines = [f"![{what}]({name})\n" for name, what in _pictures(rows, compared).items()]
    lines += [EXPLANATION, *_comparison(published, rows, compared), ""]
    lines += [*other_trainings(published.tables["main"]), *_goals(compared, rows), ""]
    of_a_batch = compare(rows, COUPLED_STACK)
    if of_a_batch:
        lines += [OF_A_BATCH, *_comparison(published, rows, of_a_batch), ""]
        lines += [*_goals(of_a_batch, rows), ""]
    return [*lines, *_costs(published, rows)]


def draw_evidence(published: Published, folder: Path) -> None:
    """Write the pictures that the section links into a folder."""
    rows = finished_rows(published)
    compared = compare(rows)
    pictures = _pictures(rows, compared)
    if CURVES in pictures:
        figures.save(_curves(rows), folder / CURVES)
    if RANKS in pictures:
        figures.save(rank_figure(_ranked(published)), folder / RANKS)


def finished_rows(published: Published) -> pd.DataFrame:
    """Return what was finished, with one setting of the couplings."""
    rows = rows_of_main(published)
    return with_numbers(rows[rows["status"] == "finished"])


def rows_of_main(published: Published) -> pd.DataFrame:
    """Return what was finished or failed, with one setting of the couplings."""
    rows = published.tables.get("main", Table.of({}, {})).rows
    fixed = [cell.gamma is None or Setting.of(cell) == FIXED for cell in rows.index]
    rows = rows.loc[np.array(fixed, dtype=bool)]
    return rows[rows["task"].isin(LETTERS)]


def _ranked(published: Published) -> pd.DataFrame:
    """Return the relative ranks of the methods, where the stack was run."""
    rows = rows_of_main(published)
    competing = (rows["method"] == STACK) | ~rows["method"].isin(NO_RIVALS)
    return relative_ranks(
        with_numbers(rows[competing]), beside=STACK, max_pairs=MAX_PAIRS
    )


def lines_of_losses(published: Published) -> list[str]:
    """Return a table of where another method is better than the stack, in Markdown."""
    rows = finished_rows(published)
    few = [one for one in compare(rows) if one.size <= MAX_PAIRS]
    return _comparison(published, rows, [o for o in few if not o.is_near(o.best)])


def compare(rows: pd.DataFrame, method: str = STACK) -> list[Comparison]:
    """Compare a stack with all other methods, by task and number of pairs.

    Args:
        rows: Those of `finished_rows`.
        method: Which stack.
    """
    compared = []
    stacks = rows[rows["method"] == method]
    for task in LETTERS:
        sizes = sorted(stacks["n_calibration"][stacks["task"] == task].unique())
        of_task = rows[rows["task"] == task] if sizes else rows[:0]
        for size in sizes:
            there = of_task[of_task["n_calibration"].isin([0, size])]
            scores = _scores(there)
            gaps = {
                name: _gap(scores[method], scores[name])
                for name in scores
                if name not in NO_RIVALS
            }
            gaps = {name: gap for name, gap in gaps.items() if len(gap)}
            if gaps:
                stack = there[there["method"] == method]
                compared.append(Comparison(task, int(size), stack, gaps))
    return compared


def _scores(rows: pd.DataFrame) -> dict[str, dict[int, float]]:
    """Return the LPP of each method, by repetition, in the order of the rows."""
    groups = rows.groupby(["method", "repetition"], sort=False)
    means = groups["lpp_z"].mean().to_dict()
    repetitions = rows["repetition"].unique()
    return {
        name: {r: means[name, r] for r in repetitions if (name, r) in means}
        for name in rows["method"].unique()
    }


def _gap(first: dict[int, float], second: dict[int, float]) -> pd.Series:
    """Return how far one method is above another; 0 where both are -inf."""
    common = [repetition for repetition in first if repetition in second]
    pairs = [(first[repetition], second[repetition]) for repetition in common]
    gaps = [0.0 if one == other else one - other for one, other in pairs]
    return pd.Series(gaps, index=common, dtype=float)


def _comparison(
    published: Published, rows: pd.DataFrame, compared: Sequence[Comparison]
) -> list[str]:
    """Return a table with the best other method of each task and number of pairs."""
    head = ("task", "pairs", "repetitions", "stack", "ACAUC", "best other")
    head += ("its LPP", "difference", "s", "calls")
    return table(head, [_entries(published, one, rows) for one in compared])


def _entries(published: Published, one: Comparison, rows: pd.DataFrame) -> list[object]:
    repetitions = one.gaps[one.best].index
    best = rows[
        (rows["method"] == one.best)
        & (rows["task"] == one.task)
        & rows["n_calibration"].isin([0, one.size])
        & rows["repetition"].isin(repetitions)
    ]
    stack = one.stack[one.stack["repetition"].isin(repetitions)]
    return [
        published.name(one.task),
        one.size,
        len(repetitions),
        f"{stack['lpp_z'].mean():.2f}",
        f"{stack['acauc'].mean():+.3f}",
        one.best,
        f"{best['lpp_z'].mean():.2f}",
        _interval(one.gap),
        f"{_seconds(stack):.0f}",
        f"{_calls(stack, rows):,.0f}",
    ]


def _interval(gap: np.ndarray) -> str:
    """Return the mean over repetitions, and how far its interval reaches."""
    width = half_width(gap)
    return f"{gap.mean():+.2f}" + (f" ± {width:.2f}" if np.isfinite(width) else "")


def half_width(gap: np.ndarray) -> float:
    """Return how far an interval over repetitions reaches; inf of a single one."""
    if len(gap) < 2 or not np.isfinite(gap).all():
        return np.inf
    quantile = student.ppf(0.5 + CONFIDENCE / 2, len(gap) - 1)
    return float(quantile * gap.std(ddof=1) / len(gap) ** 0.5)


def _seconds(rows: pd.DataFrame) -> float:
    return float((rows["seconds_train"] + rows["seconds_couple"]).mean())


def _calls(part: pd.DataFrame, rows: pd.DataFrame) -> float:
    """Return the simulations beyond those of the NPE that methods share."""
    shared = rows[(rows["method"] == "NPE") & rows["task"].isin(part["task"])]
    base = shared["num_simulations"].max() if len(shared) else 0
    return max(0.0, float(part["num_simulations"].mean()) - float(base))


def _goals(compared: Sequence[Comparison], rows: pd.DataFrame) -> list[str]:
    """Say how often each goal was met, and where it was not."""
    few = [one for one in compared if one.size <= MAX_PAIRS]
    goals = {
        f"best, or within {NEAR} nats of the best": [
            (one, one.is_near(one.best)) for one in few
        ],
        f"best, or within {NEAR} nats of the best of those that see no more data": [
            (one, one.is_near(one.best_equal))
            for one in few
            if one.best_equal is not None
        ],
        "better than the best other beyond the interval over repetitions": [
            (one, one.is_above(one.best)) for one in few
        ],
        "better beyond that interval than the best of those that are not of this "
        "package": [
            (one, one.is_above(one.best_rival))
            for one in few
            if one.best_rival is not None
        ],
        f"not more than {NEAR} nats below the prior or NPE": [
            (one, one.above_basics >= -NEAR)
            for one in few
            if one.above_basics is not None
        ],
    }
    lines = [f"With up to {MAX_PAIRS} pairs the stack is"]
    for goal, met in goals.items():
        missed = [f"{one.task} ({one.size})" for one, is_met in met if not is_met]
        lines.append(f"- {goal}: {len(met) - len(missed)} of {len(met)}")
        if missed and len(missed) <= len(met) / 2:
            lines[-1] += f"; not {', '.join(missed)}"
    acauc = np.mean([one.stack["acauc"].abs().mean() for one in few])
    text = (
        f"- of a mean |ACAUC| of {acauc:.3f} over tasks, pairs and repetitions (aimed "
        f"at {CALIBRATED}"
    )
    sbi = rows[(rows["method"] == "SBI") & rows["task"].isin([o.task for o in few])]
    if len(sbi):
        # NPE need not be calibrated even where its simulator is right.
        of_tasks = sbi["acauc"].abs().groupby(sbi["task"]).mean()
        text += f"; SBI has {of_tasks.mean():.3f} on these tasks"
    return [*lines, text + ")"]


def _costs(published: Published, rows: pd.DataFrame) -> list[str]:
    """Return seconds and calls of all methods, at 50 pairs."""
    some = rows[rows["n_calibration"].isin([0, 50])]
    tasks = [task for task in LETTERS if task in set(some["task"])]
    lines = []
    for name in METHODS:
        of_method = some[some["method"] == name]
        if name in ("prior", "SBI") or not len(of_method):
            continue
        parts = [of_method[of_method["task"] == task] for task in tasks]
        lines.append(
            [
                name,
                *(
                    f"{_seconds(part):.0f} / {_calls(part, rows):,.0f}"
                    if len(part)
                    else MISSING
                    for part in parts
                ),
            ]
        )
    head = ("50 pairs: s / calls", *(published.name(task) for task in tasks))
    return table(head, lines)


# Pictures ---------------------------------------------------------------------------


def _pictures(rows: pd.DataFrame, compared: Sequence[Comparison]) -> dict[str, str]:
    """Name the pictures that can be drawn, and what they show."""
    if not compared:
        return {}
    pictures = {
        CURVES: f"LPP and ACAUC of {len(SHOWN)} methods against the number of pairs"
    }
    pictures[RANKS] = "Mean ranks of the methods over tasks"
    return pictures


def _curves(rows: pd.DataFrame) -> Figure:
    shown = rows[rows["method"].isin(SHOWN)]
    order = [*LETTERS]
    shown = shown.iloc[shown["task"].map(order.index).argsort(kind="stable")]
    return figures.curves("n_calibration", shown, max_columns=MAX_COLUMNS)
