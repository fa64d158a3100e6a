r"""Readers of recorded data: tables, and the experiments of the causal chambers.

References:
    | Causal chambers as a real-world physical testbed for AI methodology
      (Gamella, Peters and Bühlmann, 2025)
    | https://doi.org/10.1038/s42256-024-00964-x
    | https://github.com/juangamella/causal-chamber (data under CC BY 4.0)
"""

import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.utils.errors import DataNotFoundError, InvalidInputError
from sbi_rope.utils.tensors import as_batch

DATASETS_PAGE = "https://github.com/juangamella/causal-chamber/tree/main/datasets"


def where(file: Path, root: Path | None) -> Path | None:
    """Return the place of a file below ``root`` or one of its folders, if it is there.

    One folder can hold the data of all tasks.
    """
    if root is None:
        return None
    return next(
        (p for p in (root / file, *root.glob(f"*/{file}")) if p.is_file()), None
    )


def find_file(
    file: Path, *, root: Path | None, source: str = "", download: bool = False
) -> Path:
    """Return the full path of a recorded file.

    Args:
        file: The file's path below ``root``, or below a folder in it, beginning with
            the name of the data set:
            ``lt_interventions_standard_v1/uniform_reference.csv``.
        root: Folder that holds the data sets.
        source: Where the data come from, if not from the causal chambers.
        download: Whether to download the data set into ``root`` if it is not there.

    Raises:
        DataNotFoundError: If the file is not there.
    """
    dataset = file.parts[0]
    found = where(file, root)
    if root is not None and download and not found and not (root / dataset).exists():
        _download(dataset, root)
        found = where(file, root)
    if found is None:
        get = f"Get it from {source}."
        if not source:
            get = f"Pass `download=True`, or get it from {DATASETS_PAGE}/{dataset}."
        raise DataNotFoundError(
            f"Expected the recorded file {file} in the folder `root`; got {root}. {get}"
        )
    return found


def read_columns(path: Path, columns: Sequence[str]) -> Tensor:
    """Read columns of numbers of a CSV file with any number of rows.

    Returns:
        The values, shape ``(rows, len(columns))``, float64.

    Raises:
        InvalidInputError: If columns are missing, there are no rows, or a value is not
            a finite number.
    """
    return numbers_of(read_table(path, columns), str(path))


def numbers_of(table: Any, name: str) -> Tensor:
    """Return a pandas table of finite numbers as float64; raise for any other."""
    numbers = table.apply(_require("pandas").to_numeric, errors="coerce")
    return as_batch(name, torch.tensor(numbers.to_numpy(dtype="float64")))


def read_table(path: Path, columns: Sequence[str]) -> Any:
    """Read columns of a CSV file as a pandas table."""
    # The first column is data, even if rows end with one comma too many.
    frame = _require("pandas").read_csv(path, index_col=False)
    missing = [column for column in columns if column not in frame.columns]
    if missing:
        raise InvalidInputError(
            f"Expected {path} to have the columns {list(columns)}; {missing} are "
            "missing."
        )
    return frame[list(columns)]


def read_images(folder: Path, names: Sequence[str], size: int) -> Tensor:
    """Read images of this size, as RGB, shape ``(len(names), 3, size, size)``, uint8.

    Raises:
        DataNotFoundError: If a file is not there.
    """
    pil = _require("PIL.Image")
    images = np.empty((len(names), size, size, 3), dtype=np.uint8)
    for i, name in enumerate(names):
        if not (folder / name).is_file():
            raise DataNotFoundError(f"Expected the recorded image {folder / name}.")
        with pil.open(folder / name) as image:
            images[i] = image.convert("RGB")
    return torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()


def _download(dataset: str, root: Path) -> None:
    # This import asks the internet for the list of data sets, so it comes last.
    datasets = _require("causalchamber.datasets")
    root.mkdir(parents=True, exist_ok=True)
    # Unpacked beside its place and moved there whole: what a download cut off half-way
    # leaves is never taken for data.
    with tempfile.TemporaryDirectory(prefix=".download_", dir=root) as folder:
        datasets.Dataset(dataset, root=folder, download=True)
        (Path(folder) / dataset).rename(root / dataset)


def _require(module: str) -> ModuleType:
    """Import an optional package, or say how to install it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"Recorded data need {module}. Install it with "
            f'`pip install "sbi-rope[benchmarks]"`.'
        ) from error
