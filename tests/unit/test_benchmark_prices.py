"""What the benchmark says that missing cells would cost."""

from dataclasses import replace

import pytest

from benchmarks.cells import Cell
from benchmarks.prices import Prices
from benchmarks.table import Table

ROPE = Cell(task="sir", method="RoPE", n_calibration=50, gamma=0.1, tau=1.0)
NPE = Cell(task="sir", method="NPE")


def prices(seconds: dict[Cell, tuple[float, float, float]]) -> Prices:
    """Return the prices that finished cells give by what they took."""
    names = ("seconds_train", "seconds_couple", "seconds_test")
    rows = {
        cell: vars(cell) | {"status": "finished"} | dict(zip(names, took, strict=True))
        for cell, took in seconds.items()
    }
    return Prices([Table.of(rows, {}).finished])


def test_a_repetition_costs_the_median_of_the_others() -> None:
    """One slow repetition does not change what the next is said to cost."""
    took = {replace(NPE, repetition=r): (0.0, 0.0, t) for r, t in enumerate((1, 2, 60))}
    price = prices(took).of([replace(NPE, repetition=3)])
    assert price.hours == pytest.approx(2 / 3600)
    assert price.unknown == 0


def test_training_is_paid_once_for_all_settings_of_a_coupling() -> None:
    """Cells that differ in gamma alone share the tuned network."""
    found = prices({ROPE: (100.0, 2.0, 3.0)})
    sweep = [replace(ROPE, gamma=gamma, repetition=1) for gamma in (0.1, 0.5, 1.0)]
    assert found.of(sweep).hours == pytest.approx((100 + 3 * 5) / 3600)
    assert found.of(sweep[:1]).hours == pytest.approx(105 / 3600)


def test_the_most_similar_cells_set_the_price() -> None:
    """Another number of pairs of the task comes before another task."""
    found = prices(
        {
            replace(ROPE, n_calibration=10): (10.0, 0.0, 0.0),
            replace(ROPE, task="cs"): (1000.0, 0.0, 0.0),
        }
    )
    assert found.of([ROPE]).hours == pytest.approx(10 / 3600)
    elsewhere = replace(ROPE, task="pendulum")
    assert found.of([elsewhere]).hours == pytest.approx(1000 / 3600)


def test_methods_that_were_never_run_have_no_price() -> None:
    """They are counted instead, also where nothing was run at all."""
    assert str(prices({NPE: (0.0, 0.0, 36.0)}).of([NPE, ROPE])) == "0.0 + 1 x ?"
    assert str(prices({}).of([NPE, ROPE])) == "0.0 + 2 x ?"
    assert str(prices({NPE: (0.0, 0.0, 360.0)}).of([NPE])) == "0.1"
