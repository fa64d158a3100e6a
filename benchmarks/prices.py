"""What cells that were not run would cost, from the seconds of those that were."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import pandas as pd

from benchmarks.cells import Cell
from benchmarks.schema import CELL_COLUMNS

__all__ = ["Price", "Prices"]

PARTS = ("seconds_train", "seconds_couple", "seconds_test")
# What has to be the same for the seconds of another cell to count, closest first.
ALIKE = (
    ["preset", "method", "task", "variant", "options", "n_calibration"],
    ["preset", "method", "task", "n_calibration"],
    ["preset", "method", "task"],
    ["preset", "method", "n_calibration"],
    ["preset", "method"],
)


class Price(NamedTuple):
    """The hours of one core that cells would take.

    Attributes:
        hours: The sum over those cells that are like one that was run.
        unknown: The number of cells whose method was never run.
    """

    hours: float
    unknown: int

    def __str__(self) -> str:
        if not self.unknown:
            return f"{self.hours:.1f}"
        return f"{self.hours:.1f} + {self.unknown} x ?"


class Prices:
    """Estimates what cells cost.

    A cell costs the median of the finished cells of the same method that are most like
    it: of other repetitions, of other numbers of calibration pairs, or of other tasks.
    Training counts once for all settings of a coupling, as in a run.

    Args:
        tables: Rows of finished cells, with the columns of `schema.py`.
    """

    def __init__(self, tables: Sequence[pd.DataFrame]) -> None:
        known = [table for table in tables if len(table)]
        columns = [*CELL_COLUMNS, *PARTS]
        rows = pd.concat([table[columns] for table in known]) if known else None
        self._medians = [] if rows is None else [_medians(rows, on) for on in ALIKE]

    def of(self, cells: Iterable[Cell]) -> Price:
        """Return what cells would cost together."""
        seconds, unknown = 0.0, 0
        trained = set()
        for cell in cells:
            parts = self._seconds(cell)
            if parts is None:
                unknown += 1
                continue
            train, couple, test = parts
            seconds += couple + test
            if cell.group not in trained:
                seconds += train
            trained.add(cell.group)
        return Price(seconds / 3600, unknown)

    def _seconds(self, cell: Cell) -> tuple[float, ...] | None:
        values = vars(cell)
        for on, medians in zip(ALIKE, self._medians, strict=False):
            found = medians.get(tuple(values[name] for name in on))
            if found is not None:
                return found
        return None


def _medians(
    rows: pd.DataFrame, on: list[str]
) -> dict[tuple[Any, ...], tuple[float, ...]]:
    groups = rows.astype(dict.fromkeys(PARTS, float)).groupby(on)
    medians = groups[[*PARTS]].median()
    return {
        tuple(key): tuple(row)
        for key, row in zip(medians.index, medians.to_numpy().tolist(), strict=True)
    }
