r"""Reading the causal chambers' recorded experiments.

References:
    | Causal chambers as a real-world physical testbed for AI methodology
      (Gamella, Peters and Bühlmann, 2025)
    | https://doi.org/10.1038/s42256-024-00964-x
    | https://github.com/juangamella/causal-chamber (data under CC BY 4.0)
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from sbi_rope._validation import check_finite
from sbi_rope.errors import DataNotFoundError, InvalidInputError

__all__ = ["read_columns"]

DATASETS_PAGE = "https://github.com/juangamella/causal-chamber/tree/main/datasets"


def read_columns(
    file: str,
    columns: Sequence[str],
    *,
    root: Path | None,
    download: bool = False,
) -> Tensor:
    """Read columns of a CSV file of a causal chamber data set.

    Args:
        file: The file's path below ``root``, beginning with the name of the data set:
            ``"lt_interventions_standard_v1/uniform_reference.csv"``.
        columns: Names of the columns to read.
        root: Folder that holds the data sets.
        download: Whether to download the data set into ``root`` if the file is not
            there.

    Returns:
        The values, shape ``(rows, len(columns))``, float64.

    Raises:
        DataNotFoundError: If the file is not there, after the download if asked for.
        InvalidInputError: If columns are missing, or a value is not a finite number.
    """
    if root is None:
        raise DataNotFoundError(
            f"Needs the recorded file {file}, and no `root` was given. Pass the "
            f"folder that holds it as `root`. {_how_to_get(file)}"
        )
    path = root / file
    if download and not path.is_file():
        _download(file.split("/")[0], root)
    if not path.is_file():
        raise DataNotFoundError(f"No file {path}. {_how_to_get(file)}")
    pandas = _require("pandas")
    frame = pandas.read_csv(path)
    missing = [column for column in columns if column not in frame.columns]
    if missing:
        raise InvalidInputError(
            f"Expected {path} to have the columns {list(columns)}; {missing} are "
            f"missing. The file is not the published one, or has been cut."
        )
    numbers = frame[list(columns)].apply(pandas.to_numeric, errors="coerce")
    values = torch.tensor(numbers.to_numpy(dtype="float64"))
    check_finite(str(path), values)
    return values


def _how_to_get(file: str) -> str:
    page = f"{DATASETS_PAGE}/{file.split('/')[0]}"
    return (
        f"Either pass `download=True` along with `root` (needs the package "
        f"causalchamber), or download and unpack the data set from {page}."
    )


def _download(dataset: str, root: Path) -> None:
    # This import asks the internet for the list of data sets, so it comes last.
    datasets = _require("causalchamber.datasets")
    root.mkdir(parents=True, exist_ok=True)
    datasets.Dataset(dataset, root=str(root), download=True)


def _require(module: str) -> ModuleType:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"Recorded data need {module}. Install it with "
            f'`pip install "sbi-rope[benchmarks]"`.'
        ) from error
