"""Files that are there whole or not at all, and what to do with those that are not."""

import contextlib
import itertools
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sbi_rope.errors import NotWritableError

__all__ = ["read_arrays", "set_aside", "write_atomically"]

# What numpy and zipfile raise for files that are no archives of arrays, or cut.
BROKEN = (
    *(OSError, ValueError, KeyError, EOFError, AttributeError, NotImplementedError),
    *(RuntimeError, zipfile.BadZipFile, zlib.error),
)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file, up to its last byte; nothing in it is executed.

    Raises:
        ValueError: If the file is none, or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except BROKEN as error:  # AttributeError: a single array
        raise ValueError(
            f"expected whole arrays; got {type(error).__name__}: {error}"
        ) from error


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Give a temporary path, and move what was written there to its place.

    A reader, another process that writes the same file, an end of this process or a
    power cut never leave or see half a file.

    Raises:
        NotWritableError: If nothing can be written to the folder.
    """
    # Not by `mkstemp`, whose files only their owner may read.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise NotWritableError(
            f"Expected a folder that can be written to, for {path}; got "
            f"{error.strerror or error}. Use another folder, or change its permissions."
        ) from error
    try:
        yield temporary
        # What is renamed before it is on the disk may be empty after a power cut.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync_folder(path.parent)


def set_aside(path: Path) -> Path | None:
    """Give a file another name, so that it is neither read again nor lost.

    Returns:
        The new path, ``<path>.damaged-1`` or the next that is free; None if the file is
        no longer there.
    """
    others = (
        path.with_name(f"{path.name}.damaged-{number}") for number in itertools.count(1)
    )
    other = next(other for other in others if not other.exists())
    try:
        path.rename(other)
    except FileNotFoundError:  # another process was faster
        return None
    return other


def _sync_folder(folder: Path) -> None:
    """Make sure that the new name is on the disk, too, where the system can."""
    if os.name != "posix":
        return
    # Some network file systems do not know how to; the file itself is on the disk.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
