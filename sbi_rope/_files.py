"""Write files completely or not at all, read arrays, and put damaged files aside."""

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

# What numpy and zipfile raise for a file that is cut off or is no archive of arrays.
# They raise an AttributeError for a file with a single array.
BROKEN = (
    *(OSError, ValueError, KeyError, EOFError, AttributeError, NotImplementedError),
    *(RuntimeError, zipfile.BadZipFile, zlib.error),
)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file. No code that the file may hold is executed.

    Raises:
        ValueError: If the file is no npz file or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except BROKEN as error:
        raise ValueError(
            f"expected whole arrays; got {type(error).__name__}: {error}"
        ) from error


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and move the file written there to ``path`` at the end.

    Nobody ever finds half a file under ``path``: not a reader, not another process that
    writes the same file, and not after this process is killed or the power fails. If
    ``path`` is a link, what it points to is replaced.

    Raises:
        NotWritableError: If nothing can be written to the folder, ``path`` is no
            ordinary file, such as a device, or the disk is full.
    """
    path = path.resolve()
    if path.exists() and not path.is_file():
        raise NotWritableError(
            f"Expected a file, or a path where there is nothing yet; got {path}, which "
            "is a folder or a device. Use another path."
        )
    # Files made by `mkstemp` can be read by their owner only.
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
        # If the power fails before the data are on the disk, the file may be empty.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise NotWritableError(
            f"Expected to write {path}; got {error.strerror or error}. Make room on "
            "the disk, or use another folder. What was there before is unchanged."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
    _sync_folder(path.parent)


def set_aside(path: Path) -> Path | None:
    """Rename a damaged file, so that it is not read again but not lost either.

    Returns:
        The new path, which is ``<path>.damaged-1`` or the next number that is free, or
        None if the file is no longer there.
    """
    others = (
        path.with_name(f"{path.name}.damaged-{number}") for number in itertools.count(1)
    )
    other = next(other for other in others if not other.exists())
    try:
        path.rename(other)
    except FileNotFoundError:  # another process has renamed it already
        return None
    return other


def _sync_folder(folder: Path) -> None:
    """Write the new name of a file to the disk, on systems that can."""
    if os.name != "posix":
        return
    # Some network file systems cannot. The file itself is on the disk already.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
