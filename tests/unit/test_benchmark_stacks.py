"""The stack against its candidates, from a table that is made up."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cells import Cell
from benchmarks.stacks import (
    ONE_SETTING,
    REHEARSED,
    Comparison,
    comparisons,
    other_trainings,
    stacking_lines,
)
from benchmarks.table import Table
from sbi_rope.stacking import default_candidates

TEST = {"prior": -3.0, "NPE": -9.0, ONE_SETTING: -2.0, REHEARSED: -1.5}
HELD_OUT = {"prior": -3.1, "NPE": -8.0, ONE_SETTING: -1.0, REHEARSED: -1.6}


def a_table(
    *, stacked: float = -1.2, held_out: float = -1.3, acauc: float = 0.0
) -> Table:
    cell = Cell(task="pendulum", method="stack", n_calibration=10)
    other = Cell(task="pendulum", method="prior")
    row = {
        "lpp_z": stacked,
        "acauc": acauc,
        "expected_coverage_error": 0.01,
        "seconds_train": 1.0,
        "seconds_couple": 2.0,
    }
    arrays = {
        "candidates": np.array([*TEST, "stack"]),
        "weights": np.array([0.25] * 4 + [np.nan]),
        "test": np.array(list(TEST.values())),
        "held_out": np.array([*HELD_OUT.values(), held_out]),
        "held_out_error": np.array([0.0] * 4 + [0.2]),
    }
    return Table.of({cell: row, other: dict(row)}, {cell: arrays, other: {}})


def the_comparison(**options: float) -> Comparison:
    (found,) = comparisons(a_table(**options))
    return found


def test_best_is_by_the_test_set_and_picked_is_by_held_out_pairs() -> None:
    found = the_comparison()
    assert found.best == REHEARSED
    assert found.picked == ONE_SETTING
    assert found.gap == pytest.approx(-1.2 + 1.5)


def test_a_row_shows_what_was_scored() -> None:
    (row,) = (
        line
        for line in stacking_lines(a_table())
        if line.startswith("| pendulum |") and "**" in line
    )
    entries = [entry.strip() for entry in row.strip("|").split("|")]
    # Task, variant, method, pairs, prior, NPE, two that were no candidates, best and
    # its name.
    assert entries[:10] == [
        *("pendulum", "", "stack", "10", "-3.00", "-9.00", "", "", "-1.50"),
        REHEARSED,
    ]
    assert entries[10:13] == ["-2.00", "**-1.20**", "+0.30"]
    assert entries[13].startswith("-1.30")
    assert entries[-1] == "3"


@pytest.mark.parametrize(
    ("options", "goal"),
    [
        ({"stacked": -1.55}, "better than the best"),
        ({"stacked": -1.65}, "within 0.1 nats of it"),
        ({"stacked": -3.2, "held_out": -3.2}, "below the prior or NPE"),
        ({"acauc": -0.06}, "ACAUC within"),
        ({"held_out": -1.7}, "two standard errors"),
    ],
)
def test_a_goal_that_is_missed_is_counted_as_missed(
    options: dict[str, float], goal: str
) -> None:
    def line(table: Table) -> str:
        (found,) = (text for text in stacking_lines(table) if goal in text)
        return found

    assert line(a_table()).endswith("1 of 1")
    assert "0 of 1" in line(a_table(**options))


def test_rehearsal_is_compared_where_both_were_candidates() -> None:
    assert "| pendulum |  | 10 | -2.00 | -1.50 | +0.50 |" in stacking_lines(a_table())
    names = {candidate.name for candidate in default_candidates(couplings=True)}
    assert {ONE_SETTING, REHEARSED} <= names


def test_a_stack_that_starts_from_another_npe_than_others_is_named() -> None:
    def table(npe: float | None, *stacks: tuple[int, float]) -> Table:
        (stack, row), (prior, _) = a_table().rows.iterrows()
        rows, arrays = {prior: row.to_dict()}, {prior: {}}
        if npe is not None:
            cell = replace(prior, method="NPE")
            rows[cell], arrays[cell] = {**row, "lpp_z": npe}, {}
        for size, score in stacks:
            cell = replace(stack, n_calibration=size)
            test = np.array(list({**TEST, "NPE": score}.values()))
            rows[cell] = row.to_dict()
            arrays[cell] = {**a_table().arrays[stack], "test": test}
        return Table.of(rows, arrays)

    assert other_trainings(table(-9.0, (10, -9.0), (50, -9.001))) == []
    # These are the same, although two are rounded up and one down.
    assert other_trainings(table(None, (10, -7.4951), (50, -7.4949))) == []
    *_, line, _ = other_trainings(table(-9.0, (10, -9.0), (50, -7.5), (200, -7.5)))
    assert line == (
        "- pendulum, repetition 0: -7.50 instead of -9.00 (stack with 50 pairs, stack "
        "with 200 pairs)"
    )
    # Without a row of NPE, most stacks tell.
    *_, line, _ = other_trainings(table(None, (10, -7.5), (50, -7.5), (200, -9.0)))
    assert line.endswith("-9.00 instead of -7.50 (stack with 200 pairs)")
    assert line in stacking_lines(table(None, (10, -7.5), (50, -7.5), (200, -9.0)))


def test_without_a_stack_nothing_is_said() -> None:
    assert stacking_lines(Table.of({}, {})) == []
