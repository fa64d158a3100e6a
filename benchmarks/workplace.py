"""Where a run reads and writes, and that no other run does so at the same time."""

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from benchmarks.cases import Sources
from benchmarks.checks import read_mapping
from benchmarks.store import Cache, Results
from sbi_rope._files import set_aside, write_atomically
from sbi_rope.errors import InvalidInputError, NotWritableError, warn_user

__all__ = ["Workplace"]

# Raised when the same cell gives another result than before.
FORMAT = 1
# Workers of a run that was killed need a moment to notice it.
PATIENCE = 3.0


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Where a run reads and writes, and what it runs on.

    Attributes:
        folder: Results of cells and what they share are kept below it.
        sources: Where recorded data are.
        device: Where networks are trained.
    """

    folder: Path
    sources: Sources
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
