"""Files that are there whole or not at all."""

import contextlib
import hashlib
import io
import json
import os
import secrets
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.cells import Cell

__all__ = ["Cache", "Results", "write_atomically"]


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Give a temporary path, and move what was written there to its place.

    A reader, another process that writes the same file, or a power cut never leave or
    see half a file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not by `mkstemp`, whose files only their owner may read.
    name = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
    try:
        yield name
        os.replace(name, path)
    finally:
        name.unlink(missing_ok=True)


class Cache:
    """What cells share, kept under a name made of what it depends on.

    Every entry starts with a checksum; one that does not fit is computed anew.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, kind: str, content: Any, compute: Callable[[], Any]) -> Any:
        """Return the entry, computed if it is missing or damaged.

        Args:
            kind: First part of the file's name.
            content: What the entry depends on, as JSON.
            compute: Returns the entry.
        """
        text = json.dumps(content, sort_keys=True)
        name = hashlib.sha256(text.encode()).hexdigest()[:20]
        path = self.folder / f"{kind}-{name}.pt"
        if path.exists():
            entry = self._read(path)
            if entry is not None:
                return entry[0]
            warnings.warn(f"{path} is damaged and is computed anew.", stacklevel=2)
        value = compute()
        buffer = io.BytesIO()
        torch.save(value, buffer)
        payload = buffer.getvalue()
        with write_atomically(path) as temporary:
            digest = hashlib.sha256(payload).digest()
            temporary.write_bytes(digest + payload)
        return value

    def _read(self, path: Path) -> tuple[Any] | None:
        data = path.read_bytes()
        digest, payload = data[:32], data[32:]
        if hashlib.sha256(payload).digest() != digest:
            return None
        return (torch.load(io.BytesIO(payload), weights_only=False),)


class Results:
    """The results of cells, a file each, shared by all suites."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, cell: Cell) -> dict[str, Any] | None:
        """Return the row of a cell, or None if it was not run."""
        path = self.folder / f"{cell.key}.json"
        try:
            return json.loads(path.read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return None

    def read_arrays(self, cell: Cell) -> dict[str, np.ndarray]:
        """Return what is kept of a finished cell besides its row."""
        with np.load(self.folder / f"{cell.key}.npz") as arrays:
            return dict(arrays)

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
            path.write_text(json.dumps(row, indent=1))
