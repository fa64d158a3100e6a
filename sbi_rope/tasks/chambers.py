r"""Readers of the recorded experiments of the causal chambers.

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

import torch
from torch import Tensor

from sbi_rope.errors import DataNotFoundError, InvalidInputError
from sbi_rope.tensors import as_batch

__all__ = ["find_file", "find_images", "read_columns", "read_images", "read_table"]

DATASETS_PAGE = "https://github.com/juangamella/causal-chamber/tree/main/datasets"


def find_file(file: Path, *, root: Path | None, download: bool = False) -> Path:
    """Return the full path of a recorded file.

    Args:
        file: The file's path below ``root``, beginning with the name of the data set:
            ``lt_interventions_standard_v1/uniform_reference.csv``.
        root: Folder that holds the data sets.
        download: Whether to download the data set into ``root`` if it is not there.

    Raises:
        DataNotFoundError: If the file is not there.
    """
    dataset = file.parts[0]
    if root is not None and download and not (root / dataset).exists():
        _download(dataset, root)
    if root is None or not (root / file).is_file():
        raise DataNotFoundError(
            f"Expected the recorded file {file} in the folder `root`; got {root}. Pass "
            f"`download=True`, or get it from {DATASETS_PAGE}/{dataset}."
        )
    return root / file


def read_table(path: Path, columns: Sequence[str]) -> Any:
    """Read columns of a CSV file as a pandas table.

    Raises:
        InvalidInputError: If columns are missing.
    """
    # The first column is data, even if rows end with one comma too many.
    frame = _require("pandas").read_csv(path, index_col=False)
    missing = [column for column in columns if column not in frame.columns]
    if missing:
        raise InvalidInputError(
            f"Expected {path} to have the columns {list(columns)}; {missing} are "
            "missing."
        )
    return frame[list(columns)]


def read_columns(path: Path, columns: Sequence[str]) -> Tensor:
    """Read columns of numbers of a CSV file.

    Args:
        path: The file. It may have any number of rows.
        columns: Names of the columns to read.

    Returns:
        The values, shape ``(rows, len(columns))``, float64.

    Raises:
        InvalidInputError: If columns are missing, there are no rows, or a value is not
            a finite number.
    """
    frame = read_table(path, columns)
    numbers = frame.apply(_require("pandas").to_numeric, errors="coerce")
    return as_batch(str(path), torch.tensor(numbers.to_numpy(dtype="float64")))


def find_images(experiment: Path, size: int) -> Path:
    """Return the folder with an experiment's images of one size.

    Args:
        experiment: Folder of the experiment, in which ``images_<size>`` lies.
        size: Height and width of the images, in pixels.

    Raises:
        DataNotFoundError: If there is no such folder.
    """
    folder = experiment / f"images_{size}"
    if not folder.is_dir():
        found = sorted(path.name for path in experiment.glob("images_*"))
        raise DataNotFoundError(
            f"Expected the folder {folder} for `image_size={size}`; got {found}."
        )
    return folder


def read_images(folder: Path, names: Sequence[str], size: int) -> Tensor:
    """Read square RGB images with 8 bit a channel.

    Args:
        folder: Folder of the images.
        names: File names, in any format that PIL reads.
        size: Height and width that the images have, in pixels.

    Returns:
        The images, shape ``(len(names), 3, size, size)``, uint8.

    Raises:
        DataNotFoundError: If a file is not there.
        InvalidInputError: If a file is no RGB image of this size.
    """
    pil = _require("PIL.Image")
    images = torch.empty(
        len(names), size, size, 3, dtype=torch.uint8, device=torch.device("cpu")
    )
    for i, name in enumerate(names):
        path = folder / name
        if not path.is_file():
            raise DataNotFoundError(f"Expected the image {path}, which a table names.")
        with pil.open(path) as image:
            if image.size != (size, size) or image.mode != "RGB":
                raise InvalidInputError(
                    f"Expected {path} to have {size} x {size} pixels in mode RGB; got "
                    f"{image.width} x {image.height} in mode {image.mode}."
                )
            content = torch.frombuffer(bytearray(image.tobytes()), dtype=torch.uint8)
        images[i] = content.reshape(size, size, 3)
    return images.permute(0, 3, 1, 2).contiguous()


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
