"""The stack against each of its candidates, from committed results."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.cells import Cell, data_in_words
from benchmarks.methods import STACK, STACKS
from benchmarks.table import Table, markdown

__all__ = [
    "CALIBRATED",
    "NEAR",
    "Comparison",
    "comparisons",
    "other_trainings",
    "stacking_lines",
]

# On one machine the training of NPE repeats to the digit, so that scores that differ by
# more are of two trainings.
SAME = 0.005
# The goals, fixed beforehand, in nats and ACAUC.
NEAR, CALIBRATED = 0.1, 0.05
BASICS = ("prior", "NPE", "tuning-only", "fine-tuned NPE")
ONE_SETTING = "RoPE (gamma 0.1, tau 1)"
REHEARSED = "RoPE (gamma 0.1, tau 1, rehearsal 1)"
EXPLANATION = """\
LPP on the test set, in standard deviations of the prior. "Best" is the best single
candidate *chosen on the test set*, which no user can do; "picked" is the one with the
highest score on the held-out calibration pairs. "Held out" is what these pairs say of
the stack, made without the pair that is scored, with its standard error. The stack,
RoPE and OT-only are normalised inside the support of the prior, NPE and its relatives
are scored as they are. Seconds are those of fine-tuning, cross-validation and coupling
on one thread, with other work beside it.
"""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A stack and its candidates on one set of data.

    Attributes:
        cell: The cell of the stack.
        row: Its row.
        test: Scores of the candidates on the test set, by name.
        held_out: Scores on held-out pairs, by name; the stack's too.
        held_out_error: Standard error of the stack's.
    """

    cell: Cell
    row: dict[str, Any]
    test: dict[str, float]
    held_out: dict[str, float]
    held_out_error: float

    @property
    def stacked(self) -> float:
        """The score of the stack on the test set."""
        return self.row["lpp_z"]

    @property
    def best(self) -> str:
        """The candidate with the best score on the test set."""
        return max(self.test, key=self.test.__getitem__)

    @property
    def picked(self) -> str:
        """The candidate with the best score on held-out pairs."""
        return max(self.test, key=self.held_out.__getitem__)

    @property
    def gap(self) -> float:
        """By how much the stack is above the best candidate."""
        return self.stacked - self.test[self.best]


def comparisons(table: Table) -> list[Comparison]:
    """Return all stacks of a table that were finished."""
    found = []
    for cell, row in table.rows.iterrows():
        arrays = table.arrays.get(cell, {})
        if cell.method not in STACKS or "candidates" not in arrays:
            continue
        names = [str(name) for name in arrays["candidates"]]
        found.append(
            Comparison(
                cell=cell,
                row=row.to_dict(),
                test=dict(zip(names, arrays["test"].tolist(), strict=False)),
                held_out=dict(zip(names, arrays["held_out"].tolist(), strict=True)),
                held_out_error=float(arrays["held_out_error"][-1]),
            )
        )
    return found


def _variant(cell: Cell) -> str:
    """Return the variant and the options of a cell in words."""
    return " ".join(data_in_words(cell.task, cell.variant, cell.options)[1:])


def other_trainings(table: Table) -> list[str]:
    """Name the stacks that start from another NPE than others on the same data.

    A repetition has one NPE, which is trained anew where a run goes on on another
    machine. The reference is the row of NPE, or without one that of most stacks.
    """
    found = [one for one in comparisons(table) if "NPE" in one.test]
    known = {
        _data(cell): row["lpp_z"]
        for cell, row in table.rows.iterrows()
        if cell.method == "NPE"
    }
    by_data: dict[tuple[Any, ...], list[Comparison]] = {}
    for one in found:
        by_data.setdefault(_data(one.cell), []).append(one)
    named = []
    for data, stacks in by_data.items():
        own = np.array([one.test["NPE"] for one in stacks])
        most = (np.abs(own[:, None] - own) <= SAME).sum(axis=1).argmax()
        reference = known.get(data, own[most])
        others: dict[str, list[str]] = {}
        for one, score in zip(stacks, own, strict=True):
            if abs(score - reference) > SAME:
                name = f"{one.cell.method} with {one.cell.n_calibration} pairs"
                others.setdefault(f"{score:.2f}", []).append(name)
        cell = stacks[0].cell
        where = " ".join(data_in_words(cell.task, cell.variant, cell.options))
        named += [
            f"- {where}, repetition {cell.repetition}: {score} instead of "
            f"{reference:.2f} ({', '.join(names)})"
            for score, names in others.items()
        ]
    if not named:
        return []
    return [
        "These stacks start from another training of NPE, with the same settings on",
        "the same data, as it happens on another machine. LPP of this NPE, and of that",
        "in the row of NPE or, without such a row, in most other stacks:",
        "",
        *named,
        "",
    ]


def _data(cell: Cell) -> tuple[Any, ...]:
    return cell.task, cell.variant, cell.options, cell.preset, cell.repetition


def stacking_lines(table: Table) -> list[str]:
    """Return the comparison of all stacks in Markdown; nothing if there is none."""
    found = comparisons(table)
    if not found:
        return []
    heads = ("task", "variant", "method", "pairs")
    heads += (*BASICS, "best", "", "picked", "**stack**")
    heads += ("stack - best", "held out", "ACAUC", "ECE", "s")
    lines = ["## The stack against its candidates", "", EXPLANATION]
    lines += markdown(heads, map(_entries, found))
    return [
        *(*lines, "", *other_trainings(table)),
        *(*_goals(found), "", *_rehearsal(found)),
    ]


def _entries(one: Comparison) -> list[str]:
    row = one.row
    seconds = row["seconds_train"] + row["seconds_couple"]
    return [
        one.cell.task,
        _variant(one.cell),
        one.cell.method,
        str(one.cell.n_calibration),
        *(f"{one.test[name]:.2f}" if name in one.test else "" for name in BASICS),
        f"{one.test[one.best]:.2f}",
        one.best,
        f"{one.test[one.picked]:.2f}",
        f"**{one.stacked:.2f}**",
        f"{one.gap:+.2f}",
        f"{one.held_out[STACK]:.2f} ± {one.held_out_error:.2f}",
        f"{row['acauc']:+.3f}",
        f"{row['expected_coverage_error']:.3f}",
        f"{seconds:.0f}",
    ]


def _goals(found: list[Comparison]) -> list[str]:
    """Say how often each goal was met, and where it was not."""
    honest = [
        abs(one.held_out[STACK] - one.stacked) <= 2 * one.held_out_error
        for one in found
    ]
    goals = {
        "better than the best candidate chosen on the test set": [
            one.gap > 0 for one in found
        ],
        f"within {NEAR} nats of it, or better": [one.gap >= -NEAR for one in found],
        f"not more than {NEAR} nats below the prior or NPE": [
            one.stacked
            >= max(one.test.get(name, -np.inf) for name in ("prior", "NPE")) - NEAR
            for one in found
        ],
        f"ACAUC within {CALIBRATED}": [
            abs(one.row["acauc"]) <= CALIBRATED for one in found
        ],
        "test score within two standard errors of the held-out score": honest,
    }
    lines = []
    for goal, met in goals.items():
        lines.append(f"- {goal}: {sum(met)} of {len(met)}")
        missed = [str(one.cell) for one, ok in zip(found, met, strict=True) if not ok]
        if missed and len(missed) <= len(met) / 2:
            lines[-1] += f"; not {', '.join(missed)}"
    return lines


def _rehearsal(found: list[Comparison]) -> list[str]:
    """Compare RoPE with and without rehearsal, where both were candidates."""
    # What docs/background/benchmark.md says of rehearsal stands on this table.
    both = [one for one in found if ONE_SETTING in one.test and REHEARSED in one.test]
    if not both:
        return []
    lines = []
    for one in both:
        without, rehearsed = one.test[ONE_SETTING], one.test[REHEARSED]
        numbers = f"{without:.2f}", f"{rehearsed:.2f}", f"{rehearsed - without:+.2f}"
        cell = one.cell
        lines.append([cell.task, _variant(cell), cell.n_calibration, *numbers])
    heads = ("task", "variant", "pairs", "without", "with", "gain")
    what = f"{ONE_SETTING} with and without rehearsal, on the test set:"
    return [what, "", *markdown(heads, lines)]
