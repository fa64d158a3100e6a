"""The folder of a run: its results, what cells share, and who is at work in it."""

import contextlib
import hashlib
import io
import json
import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from filelock import FileLock, Timeout

from benchmarks.cells import Cell
from benchmarks.schema import check_row, check_scores
from sbi_rope._files import read_arrays, set_aside, write_atomically
from sbi_rope.errors import InvalidInputError, NotWritableError, warn_user

if TYPE_CHECKING:
    from benchmarks.cases import Sources

__all__ = ["Cache", "Results", "Workplace", "read_mapping"]

# torch before 2.6 can be made to run code by other files than these.
ZIP = b"PK\x03\x04"
# Raised when the same cell gives another result than before.
FORMAT = 1
# Older wordings of presets.py, by checksum: what they set is what it sets today, but
# for the preset "smoke", whose numbers mean nothing.
SAME_PRESETS = (
    "206a0dddeee8bb6b4fa1f8a6cfa129b19d8007389eb68118cd4001ab3e3b4350",
    "07d8c03d7eaad83d3896aee518d3ecad9e20c8f8fee87d4ec7e5b62bf7b9828a",
)
# Workers of a run that was killed need a moment to notice it.
PATIENCE = 3.0


def read_mapping(path: Path) -> dict[str, Any]:
    """Read names and values from a JSON file.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it holds something else, or is damaged.
    """
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise InvalidInputError(
            f"expected names and values; got {type(content).__name__}"
        )
    return content


def _as_it_is(value: Any) -> Any:
    return value


class Cache:
    """What cells share, kept under a name made of what it depends on.

    This is not joblib's ``Memory``, which keeps pickles, and reading a pickle can run
    code. Entries are tensors, numbers, texts and collections of them. Each starts with
    a checksum against accidents. One that cannot be used is set aside and computed
    anew.
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


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Where a run reads and writes, and what it runs on.

    Attributes:
        folder: Results of cells and what they share are kept below it.
        sources: Where recorded data are.
        device: Where networks are trained.
    """

    folder: Path
    sources: "Sources"
    device: str = "cpu"

    @property
    def results(self) -> Results:
        """The finished cells."""
        return Results(self.folder / "cells")

    @property
    def cache(self) -> Cache:
        """What cells share."""
        return Cache(self.folder / "cache")

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Keep other runs out of the folder, whose results are all made in one way.

        The system lifts the lock when this process ends, however it ends.

        Raises:
            InvalidInputError: If another run is at work in it.
            NotWritableError: If nothing can be written to it.
            SystemExit: If it holds results of other data, devices or settings.
        """
        lock = FileLock(self.folder / "run.lock")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=PATIENCE)
        except Timeout as error:
            raise InvalidInputError(
                f"Expected a folder that no other run is working in; another process "
                f"works in {self.folder} now. Wait until it is done, stop it, or use "
                "another --out."
            ) from error
        except OSError as error:
            raise NotWritableError(
                f"Expected a folder that can be written to; got {self.folder}: "
                f"{error.strerror or error}. Use another --out, or change its "
                "permissions."
            ) from error
        try:
            self._check_place()
            yield
        finally:
            lock.release()

    def _check_place(self) -> None:
        place = {
            "format": FORMAT,
            "root": str(self.sources.root and self.sources.root.resolve()),
            "hemodynamics": str(
                self.sources.hemodynamics and self.sources.hemodynamics.resolve()
            ),
            "device": self.device,
            "presets": hashlib.sha256(
                (Path(__file__).parent / "presets.py").read_bytes()
            ).hexdigest(),
        }
        before = self._place_before()
        if before is None:
            if any(self.results.folder.glob("*.json")):
                warn_user(
                    f"What the results in {self.folder} were made with is not known. "
                    "They are taken for results of the same data, device and "
                    "settings as those of this run; use another --out if they are not."
                )
            with write_atomically(self.folder / "place.json") as temporary:
                temporary.write_text(json.dumps(place, indent=1), encoding="utf-8")
            return
        if before.get("presets") in SAME_PRESETS:
            before = before | {"presets": place["presets"]}
        other = [name for name, value in place.items() if before.get(name) != value]
        if other:
            raise SystemExit(
                f"{self.folder} holds results of another {', '.join(other)} "
                f"({[before.get(name) for name in other]}). Use another --out."
            )

    def _place_before(self) -> dict[str, Any] | None:
        """Return what the folder was used with; None if that is not known."""
        path = self.folder / "place.json"
        try:
            return read_mapping(path)
        except FileNotFoundError:
            return None
        except ValueError as error:
            warn_user(f"{path} is damaged and is now {set_aside(path)}: {error}.")
            return None
