"""What a run keeps: what cells share, and the results of cells."""

import hashlib
import io
import json
import pickle
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.cells import Cell
from benchmarks.checks import check_scores, read_mapping
from benchmarks.schema import check_row
from sbi_rope._files import read_arrays, set_aside, write_atomically
from sbi_rope.errors import warn_user

__all__ = ["Cache", "Results"]

# torch before 2.6 can be made to run code by other files than these.
ZIP = b"PK\x03\x04"


def _as_it_is(value: Any) -> Any:
    return value


class Cache:
    """What cells share, kept under a name made of what it depends on.

    Entries are tensors, numbers, texts and collections of them, and reading them never
    runs code. Every entry starts with a checksum against accidents. One that cannot be
    used is set aside and computed anew.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(
        self,
        kind: str,
        content: Any,
        compute: Callable[[], Any],
        *,
        pack: Callable[[Any], Any] = _as_it_is,
        unpack: Callable[[Any], Any] = _as_it_is,
    ) -> Any:
        """Return the entry, computed if it is missing or damaged.

        Args:
            kind: First part of the file's name.
            content: What the entry depends on, as JSON.
            compute: Returns the entry.
            pack: Returns what is kept of an entry.
            unpack: Makes the entry of what was kept; may raise any error if that is
                not fit for it.
        """
        text = json.dumps(content, sort_keys=True)
        name = hashlib.sha256(text.encode()).hexdigest()[:20]
        path = self.folder / f"{kind}-{name}.pt"
        if path.exists():
            try:
                return unpack(_read(path))
            # Whatever it is that is wrong with the file, the entry can be made again.
            except Exception as error:
                other = set_aside(path)
                warn_user(
                    f"{path} is damaged and is computed anew; what was there is now "
                    f"{other}: {error}"
                )
        value = compute()
        buffer = io.BytesIO()
        torch.save(pack(value), buffer)
        payload = buffer.getvalue()
        with write_atomically(path) as temporary:
            digest = hashlib.sha256(payload).digest()
            temporary.write_bytes(digest + payload)
        return value


def _read(path: Path) -> Any:
    data = path.read_bytes()
    digest, payload = data[:32], data[32:]
    if hashlib.sha256(payload).digest() != digest:
        raise ValueError("its checksum is wrong.")
    if not payload.startswith(ZIP):
        raise ValueError("it is not what torch writes.")
    try:
        return torch.load(io.BytesIO(payload), weights_only=True)
    except pickle.UnpicklingError as error:
        raise ValueError(
            "it holds more than tensors and numbers, as those of older versions do. It "
            "was not opened, because that could run code."
        ) from error


class Results:
    """The results of cells, one or two files each, shared by all suites."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self, cell: Cell) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        """Return the row and the arrays of a cell; None if it was not run.

        A damaged result counts as not run, with a warning.
        """
        try:
            return self._load(cell)
        except FileNotFoundError:
            return None
        except ValueError as error:
            warn_user(
                f"The result of {cell} is damaged and counts as not run. {error}. "
                "`run` sets it aside and computes it again."
            )
            return None

    def read(self, cell: Cell) -> dict[str, Any] | None:
        """Return the row of a cell, or None if it was not run or is damaged."""
        found = self.load(cell)
        return None if found is None else found[0]

    def read_arrays(self, cell: Cell) -> dict[str, np.ndarray]:
        """Return what is kept of a finished cell besides its row."""
        return read_arrays(self.folder / f"{cell.key}.npz")

    def write(
        self, cell: Cell, row: dict[str, Any], arrays: dict[str, np.ndarray]
    ) -> None:
        """Write a result; the row comes last and says that all is there."""
        if arrays:
            with (
                write_atomically(self.folder / f"{cell.key}.npz") as path,
                path.open("wb") as file,
            ):
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        with write_atomically(self.folder / f"{cell.key}.json") as path:
            path.write_text(json.dumps(asdict(cell) | row, indent=1), encoding="utf-8")

    def set_damaged_aside(self, cells: Iterable[Cell]) -> None:
        """Give damaged results other names, and say so, so that they are made again."""
        for cell in cells:
            try:
                self._load(cell)
            except FileNotFoundError:
                continue
            except ValueError as error:
                files = [self.folder / f"{cell.key}.{end}" for end in ("json", "npz")]
                new = [set_aside(path) for path in files if path.exists()]
                warn_user(
                    f"The result of {cell} is damaged and is computed again. {error}. "
                    f"What was there is now {', '.join(map(str, filter(None, new)))}."
                )

    def _load(self, cell: Cell) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Read a result and check that it is one of this cell.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is damaged. It names the file.
        """
        path = self.folder / f"{cell.key}.json"
        try:
            row = read_mapping(path)
            check_row(row, cell)
            if row["status"] == "failed":
                return row, {}
            path = path.with_suffix(".npz")
            arrays = self.read_arrays(cell)
            check_scores(row, cell, arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return row, arrays
