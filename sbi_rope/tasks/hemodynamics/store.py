"""Arrays in files, which are whole or not there, and always the same bytes."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sbi_rope._files import write_atomically

__all__ = ["read_arrays", "write_arrays"]

FIXED_DATE = (1980, 1, 1, 0, 0, 0)  # equal arrays make equal files
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


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to an uncompressed npz file that is there once it is whole."""
    with (
        write_atomically(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", FIXED_DATE)
            with archive.open(member, "w", force_zip64=True) as file:
                np.lib.format.write_array(
                    file, np.asarray(array, order="C"), allow_pickle=False
                )
