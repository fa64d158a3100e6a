"""Results of cells: a CSV file for each suite, with arrays beside it.

A folder of results holds a folder for each suite, with `results.csv`, a row for each
cell, and `arrays.npz`, where an array is named by its cell (`KEY/log_probs`).
"""

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.cells import Cell
from sbi_rope.utils.files import write_atomically

__all__ = ["WHERE", "Result", "Results"]

CELL_COLUMNS = [field.name for field in fields(Cell)]
COLUMNS = [
    *("suite", *CELL_COLUMNS, "status"),
    *("lpp", "lpp_z", "lpp_median", "lpp_standard_error", "neg_inf_fraction"),
    *("acauc", "acauc_standard_error", "acauc_per_parameter"),
    *("expected_coverage_error", "c2st", "converged", "n_test", "stand_in"),
    *("seconds_npe", "seconds_train", "seconds_couple", "seconds_test"),
    *("num_simulations", "peak_memory_mb", "device", "versions", "git_commit"),
    *("finished_at", "error"),
]
TEXTS = [
    *("suite", "task", "variant", "options", "preset", "method", "cost_scale"),
    *("status", "acauc_per_parameter", "device", "versions", "git_commit"),
    *("finished_at", "error"),
]
# Cells with the same of these have the same data.
WHERE = ["task", "variant", "options"]

Arrays = dict[str, np.ndarray]


class Result(NamedTuple):
    """The row of a cell and, if it is finished, its arrays."""

    row: dict[str, Any]
    arrays: Arrays


class Results:
    """The results of a suite.

    Args:
        folder: Where they are. It has the name of the suite.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / "results.csv"

    @property
    def rows(self) -> pd.DataFrame:
        """The rows, with numbers as numbers. Their index holds the cells."""
        rows = self._texts()
        for name in rows.columns.difference(TEXTS):
            rows[name] = [_value(text) for text in rows[name]]
        return rows.infer_objects()

    def arrays(self) -> dict[Cell, Arrays]:
        """Return the arrays of each cell, by name."""
        status = self._texts()["status"]
        arrays: dict[Cell, Arrays] = {cell: {} for cell in status.index}
        by_key = {
            cell.key: parts
            for cell, parts in arrays.items()
            if status[cell] != "failed"
        }
        # What is not tidied yet comes last, because it is newer.
        for path in (*self.folder.glob("*.npz"), *self.folder.glob("arrays/*.npz")):
            with np.load(path) as archive:
                for name in archive.files:
                    key, _, part = name.partition("/")
                    if key in by_key:
                        by_key[key][part] = archive[name]
        return arrays

    def add(self, results: Iterable[Result]) -> None:
        """Add results, in place of earlier ones of the same cells.

        The arrays come first: a cell that has a row is complete.
        """
        parts = [*results]
        new = pd.DataFrame(
            [[_as_text(part.row.get(name)) for name in COLUMNS] for part in parts],
            columns=COLUMNS,
            dtype=object,
        ).assign(suite=self.folder.name)
        new = new.set_index(_cells_of(new))
        for cell, (_, arrays) in zip(new.index, parts, strict=True):
            if arrays:
                _write_arrays(
                    self.folder / "arrays" / f"{cell.key}.npz", {cell: arrays}
                )
        old = self._texts()
        self._write(pd.concat([old[~old.index.isin(new.index)], new]))

    def take_over(self, cells: Sequence[Cell]) -> None:
        """Copy results of cells that other suites in the same folder have."""
        for path in sorted(self.folder.parent.glob("*/results.csv")):
            other = Results(path.parent)
            rows = other._texts()
            shared = rows[
                rows.index.isin(cells) & ~rows.index.isin(self._texts().index)
            ]
            if len(shared):
                arrays = other.arrays()
                self.add(
                    Result(row.to_dict(), arrays[cell])
                    for cell, row in shared.iterrows()
                )

    def tidy(self, order: Sequence[Cell]) -> None:
        """Put the rows into the order of some cells, and all arrays into one file."""
        places = {cell: number for number, cell in enumerate(order)}
        rows = self._texts()
        ranks = [places.get(cell, len(places)) for cell in rows.index]
        self._write(rows.iloc[np.argsort(ranks, kind="stable")])
        _write_arrays(self.folder / "arrays.npz", self.arrays())
        shutil.rmtree(self.folder / "arrays", ignore_errors=True)

    def _texts(self) -> pd.DataFrame:
        """Read all as text, so that what is written again stays as it was."""
        if not self.path.exists():
            return pd.DataFrame(columns=COLUMNS, dtype=object)
        texts = pd.read_csv(self.path, dtype=object, keep_default_na=False)
        return texts.set_index(_cells_of(texts))

    def _write(self, texts: pd.DataFrame) -> None:
        with write_atomically(self.path) as path:
            texts.to_csv(path, index=False, lineterminator="\r\n")


def _value(text: str) -> Any:
    known = {"": np.nan, "True": True, "False": False}
    if text in known:
        return known[text]
    return int(text) if text.isdigit() else float(text)


def _as_text(value: Any) -> str:
    return "" if value is None else str(value)


def _cells_of(texts: pd.DataFrame) -> pd.Index:
    cells = [
        Cell(
            **row
            | {name: int(row[name]) for name in ("n_calibration", "repetition")}
            | {
                name: float(row[name]) if row[name] else None
                for name in ("gamma", "tau")
            }
        )
        for row in texts[CELL_COLUMNS].to_dict("records")
    ]
    # Cells are no sequences, but an index of objects has to be asked for.
    return pd.Index(cells, dtype=object)


def _write_arrays(path: Path, arrays: dict[Cell, Arrays]) -> None:
    flat = {
        f"{cell.key}/{name}": values
        for cell, parts in arrays.items()
        for name, values in parts.items()
    }
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **flat)  # type: ignore[arg-type]
