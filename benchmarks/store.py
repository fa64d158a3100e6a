"""Results of cells: a CSV file for each suite.

A folder of results holds a folder for each suite, with `results.csv`, a row for each
cell. Beside it is what the scores were made from: `arrays/KEY.npz` for a cell whose
`key` is KEY. Nothing reads these but whoever wants to look closer.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.cells import Cell
from sbi_rope.utils.files import write_atomically

CELL_COLUMNS = [field.name for field in fields(Cell)]
COLUMNS = [
    *("suite", *CELL_COLUMNS, "status"),
    *("lpp", "lpp_z", "lpp_median", "lpp_standard_error", "neg_inf_fraction"),
    *("acauc", "acauc_standard_error", "acauc_per_parameter"),
    *("converged", "n_test", "stand_in"),
    *("held_out", "held_out_error", "best_candidate", "best_basic"),
    *("seconds_npe", "seconds_train", "seconds_couple", "seconds_test"),
    *("num_simulations", "device", "versions", "git_commit", "finished_at", "error"),
]
TEXTS = [
    *("suite", "task", "variant", "options", "preset", "method", "cost_scale"),
    *("status", "acauc_per_parameter", "device", "versions", "git_commit"),
    *("finished_at", "error"),
]


class Result(NamedTuple):
    """The row of a cell and, if it is finished, its arrays."""

    row: dict[str, Any]
    arrays: dict[str, np.ndarray]


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

    def add(self, results: Iterable[Result]) -> None:
        """Add results, in place of earlier ones of the same cells."""
        results = [*results]
        texts = [[_as_text(row.get(name)) for name in COLUMNS] for row, _ in results]
        new = pd.DataFrame(texts, columns=COLUMNS, dtype=object)
        new = new.assign(suite=self.folder.name).set_index(_cells_of(new))
        # The arrays come first: a cell that has a row is complete.
        for cell, (_, arrays) in zip(new.index, results, strict=True):
            if arrays:
                path = self.folder / "arrays" / f"{cell.key}.npz"
                with write_atomically(path) as temporary, temporary.open("wb") as file:
                    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        self._add(new)

    def take_over(self, cells: Collection[Cell]) -> None:
        """Copy rows of cells that other suites in the same folder have."""
        for path in sorted(self.folder.parent.glob("*/results.csv")):
            rows, own = Results(path.parent)._texts(), self._texts()
            shared = rows.index.isin(cells) & ~rows.index.isin(own.index)
            if shared.any():
                self._add(rows[shared].assign(suite=self.folder.name))

    def sort(self, order: Sequence[Cell]) -> None:
        """Put the rows into the order of some cells."""
        places = {cell: number for number, cell in enumerate(order)}
        rows = self._texts()
        ranks = [places.get(cell, len(places)) for cell in rows.index]
        self._write(rows.iloc[np.argsort(ranks, kind="stable")])

    def _add(self, new: pd.DataFrame) -> None:
        old = self._texts()
        self._write(pd.concat([old[~old.index.isin(new.index)], new]))

    def _texts(self) -> pd.DataFrame:
        """Read all as text, so that what is written again stays as it was."""
        if not self.path.exists():
            return pd.DataFrame(columns=COLUMNS, dtype=object)
        texts = pd.read_csv(self.path, dtype=object, keep_default_na=False)
        return texts.set_index(_cells_of(texts))

    def _write(self, texts: pd.DataFrame) -> None:
        # Older tables lack columns, or have some that are not made any more.
        with write_atomically(self.path) as path:
            texts.fillna("").to_csv(path, index=False, lineterminator="\r\n")


def _value(text: str) -> Any:
    known = {"": np.nan, "True": True, "False": False}
    if text in known:
        return known[text]
    return int(text) if text.isdigit() else float(text)


def _as_text(value: Any) -> str:
    return "" if value is None else str(value)


def _cells_of(texts: pd.DataFrame) -> pd.Index:
    cells = []
    for row in texts[CELL_COLUMNS].to_dict("records"):
        for name in ("n_calibration", "repetition"):
            row[name] = int(row[name])
        for name in ("gamma", "tau"):
            row[name] = float(row[name]) if row[name] else None
        cells.append(Cell(**row))
    # Cells are no sequences, but an index of objects has to be asked for.
    return pd.Index(cells, dtype=object)
