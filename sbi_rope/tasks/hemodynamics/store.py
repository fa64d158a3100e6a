"""Writes arrays to files, whole or not at all, always the same bytes."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sbi_rope._files import write_atomically

__all__ = ["write_arrays"]

FIXED_DATE = (1980, 1, 1, 0, 0, 0)  # equal arrays make equal files


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
