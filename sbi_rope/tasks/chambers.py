r"""Readers of the recorded experiments of the causal chambers.

References:
    | Causal chambers as a real-world physical testbed for AI methodology
      (Gamella, Peters and Bühlmann, 2025)
    | https://doi.org/10.1038/s42256-024-00964-x
    | https://github.com/juangamella/causal-chamber (data under CC BY 4.0)
"""

import tempfile
from collections.abc import Sequence
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from sbi_rope.errors import DataNotFoundError, InvalidInputError, shown, warn_user
from sbi_rope.settings import check

__all__ = [
    "CUT_FILE",
    "check_complete",
    "check_download",
    "find_file",
    "find_images",
    "read_columns",
    "read_images",
    "read_names",
    "read_table",
    "require",
]

DATASETS_PAGE = "https://github.com/juangamella/causal-chamber/tree/main/datasets"
# MD5 sums of the archives that the tasks were written for.
KNOWN_ARCHIVES = {
    "lt_camera_v1": "1f35abfc03676d61e9b49083eb466edc",
    "lt_interventions_standard_v1": "476664d024f88e8b7640998bb5e9ee33",
    "wt_intake_impulse_v1": "8b7a0e587d3e9a804b380d96f14a1b12",
}
CUT_FILE = (
    "The file is not the published one, or has been cut: remove the data set's folder "
    "and get it again."
)
# Rows of the published experiments, by pattern of their names; the first that fits.
PUBLISHED_ROWS: dict[str, dict[str, tuple[int, ...]]] = {
    "lt_camera_v1": {
        "uniform_*": (10_000,),
        "betab_*": (10_000,),
        "scm_1_*": (5000,),
        "scm_*": (1000,),
    },
    "lt_interventions_standard_v1": {
        # The first 6000 rows are handed on by themselves as well.
        "uniform_reference": (10_000, 6000),
        "uniform_*": (1000,),
    },
    "wt_intake_impulse_v1": {"load_out_*_osr_downwind_*": (250_000,)},
}
# Larger than what any sensor reads. Sums and differences of such numbers, which may
# be wrong but are finite, stay finite in float32.
LARGEST_READING = 1e30


def check_download(
    root: Path | None, required: Sequence[Path], *, download: bool
) -> None:
    """Raise if files are to be downloaded and no ``root`` is given for them."""
    check("download", download, bool)
    if download and required and root is None:
        raise InvalidInputError(
            "Expected `root` with `download=True`: the folder to download into; got "
            "None."
        )


def find_file(file: Path, *, root: Path | None, download: bool = False) -> Path:
    """Return the full path of a recorded file.

    Args:
        file: The file's path below ``root``, beginning with the name of the data set:
            ``lt_interventions_standard_v1/uniform_reference.csv``.
        root: Folder that holds the data sets.
        download: Whether to download the data set into ``root`` if it is not there.

    Raises:
        DataNotFoundError: If the file is not there, after the download if asked for;
            the message says what is there instead.
    """
    dataset = file.parts[0]
    if root is None:
        raise DataNotFoundError(
            f"Needs the recorded file {file}, and no `root` was given. Pass the "
            f"folder that holds it as `root`. {_how_to_get(dataset)}"
        )
    if download and not (root / dataset).exists():
        _download(dataset, root)
    path = root / file
    if not path.is_file():
        raise DataNotFoundError(
            f"No file {path}. {_what_is_there(root / dataset)} {_how_to_get(dataset)}"
        )
    return path


def read_table(path: Path, columns: Sequence[str]) -> Any:
    """Read columns of a CSV file as a pandas table.

    Raises:
        InvalidInputError: If columns are missing, the file is no table, or a row ends
            early.
    """
    pandas = require("pandas")
    _check_lines(path)
    try:
        # The first column is data, even if rows end with one comma too many.
        frame = pandas.read_csv(path, index_col=False)
    except ValueError as error:  # pandas' own errors of parsing are ValueErrors
        raise InvalidInputError(
            f"Expected {path} to be a CSV table; {str(error).strip()}. {CUT_FILE}"
        ) from error
    missing = [column for column in columns if column not in frame.columns]
    if missing:
        raise InvalidInputError(
            f"Expected {path} to have the columns {list(columns)}; {missing} are "
            f"missing. {CUT_FILE}"
        )
    return frame[list(columns)]


def read_columns(path: Path, columns: Sequence[str]) -> Tensor:
    """Read columns of numbers of a CSV file.

    Args:
        path: The file.
        columns: Names of the columns to read.

    Returns:
        The values, shape ``(rows, len(columns))``, float64.

    Raises:
        InvalidInputError: If columns are missing, there are no rows, or a value is not
            a finite number, or larger than any reading.
    """
    frame = read_table(path, columns)
    if frame.empty:
        raise InvalidInputError(f"Expected {path} to have rows. {CUT_FILE}")
    numbers = frame.apply(require("pandas").to_numeric, errors="coerce")
    values = torch.tensor(numbers.to_numpy(dtype="float64"))
    bad = ~(values.abs() <= LARGEST_READING)  # NaN included
    if bad.any():
        row, column = bad.nonzero()[0].tolist()
        raise InvalidInputError(
            f"Expected {path} to hold finite numbers of a sensor's size; row {row} has "
            f"{shown(str(frame.iloc[row, column]))} in the column {columns[column]!r} "
            f"({int(bad.sum())} such places in all). {CUT_FILE}"
        )
    return values


def check_complete(path: Path, found: int, *, dataset: str) -> None:
    """Raise unless a published experiment has as many rows as were published.

    Nothing else shows that a file has been cut between two rows. The rows that are
    left would be split in another way than those of the whole file.

    Args:
        path: The file that was read. Its name is that of the experiment.
        found: Number of rows in it.
        dataset: Name of the data set.
    """
    for pattern, rows in PUBLISHED_ROWS.get(dataset, {}).items():
        if fnmatchcase(path.stem, pattern):
            if found not in rows:
                published = " or ".join(map(str, rows))
                raise InvalidInputError(
                    f"Expected {path} to have {published} rows; its last row is row "
                    f"{found - 1}, counted from 0. {CUT_FILE} A file that was "
                    "shortened on purpose can be given a name of its own, to be passed "
                    "as `experiment`."
                )
            return


def read_names(path: Path, column: str) -> list[str]:
    """Read a column of file names of a CSV file.

    Raises:
        InvalidInputError: If the column is missing, or a row has no name.
    """
    names = read_table(path, [column])[column]
    unnamed = names.isna().to_numpy().nonzero()[0].tolist()
    if unnamed:
        raise InvalidInputError(
            f"Expected every row of {path} to have a name in the column {column!r}; "
            f"the rows {unnamed[:5]} have none. {CUT_FILE}"
        )
    return [str(name) for name in names]


def find_images(experiment: Path, size: int) -> Path:
    """Return the folder with an experiment's images of one size.

    Args:
        experiment: Folder of the experiment, in which ``images_<size>`` lies.
        size: Height and width of the images, in pixels.

    Raises:
        DataNotFoundError: If there is no such folder; the message lists the sizes
            there are.
    """
    folder = experiment / f"images_{size}"
    if not folder.is_dir():
        sizes = sorted(path.name[7:] for path in experiment.glob("images_*"))
        dataset = experiment.parent.name
        raise DataNotFoundError(
            f"No folder {folder}. The sizes of the images there are {sizes}: choose "
            f"one of them as `image_size`, or get the newest version of the data set. "
            f"{_how_to_get(dataset)}"
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
        InvalidInputError: If a file cannot be read to its end, or is no RGB image of
            this size.
    """
    images = torch.empty(
        len(names), size, size, 3, dtype=torch.uint8, device=torch.device("cpu")
    )
    for i, name in enumerate(names):
        path = folder / name
        if not path.is_file():
            raise DataNotFoundError(
                f"No image {path}, which the experiment's table names. The data set is "
                f"not whole: remove its folder and get it again."
            )
        content = _read_image(path, size)
        images[i] = torch.frombuffer(content, dtype=torch.uint8).reshape(size, size, 3)
    return images.permute(0, 3, 1, 2).contiguous()


def _check_lines(path: Path) -> None:
    """Raise if a row ends before its last column, or the last row without a line end.

    pandas would take the missing columns for empty ones. It cannot tell that a number
    at the end of the file has lost its last digits.
    """
    line, number, commas, width, columns = b"\n", 0, 0, 0, [""]
    with path.open("rb") as file:
        for number, line in enumerate(file):
            commas = line.count(b",")
            if number == 0:
                width, columns = commas, line.decode(errors="replace").split(",")
            elif commas < width and line.strip():
                raise InvalidInputError(
                    f"Expected {path} to have {width + 1} columns in every row; row "
                    f"{number - 1} ends in the column {columns[commas].strip()!r}. "
                    f"{CUT_FILE}"
                )
    if not line.endswith(b"\n"):
        raise InvalidInputError(
            f"Expected {path} to end with a line end; its last row, {number - 1}, ends "
            f"in the column {columns[min(commas, width)].strip()!r}. {CUT_FILE}"
        )


def _read_image(path: Path, size: int) -> bytearray:
    """Return the bytes of an image, pixel by pixel."""
    image_module = require("PIL.Image")
    try:
        with image_module.open(path) as image:
            found = f"{image.width} x {image.height} pixels in mode {image.mode}"
            fits = image.size == (size, size) and image.mode == "RGB"
            content = bytearray(image.tobytes() if fits else b"")
    except (
        OSError,  # these are what PIL's decoders raise
        SyntaxError,
        ValueError,
        image_module.DecompressionBombError,
    ) as error:
        raise InvalidInputError(
            f"Expected {path} to be an image; {error}. {CUT_FILE}"
        ) from error
    if not fits:
        raise InvalidInputError(
            f"Expected {path} to have {size} x {size} pixels in mode RGB; got {found}. "
            f"{CUT_FILE}"
        )
    return content


def _what_is_there(folder: Path) -> str:
    if not folder.parent.is_dir():
        return f"There is no folder {folder.parent}."
    if not folder.is_dir():
        return f"There is no folder {folder}."
    names = sorted(
        path.name.removesuffix(".csv")
        for path in folder.iterdir()
        if path.is_dir() or path.suffix == ".csv"
    )
    return f"The data set has {names or 'no experiments'}."


def _how_to_get(dataset: str) -> str:
    return (
        f"Either pass `download=True` along with a `root` without a folder {dataset} "
        f"(needs the package causalchamber), or download and unpack the data set from "
        f"{DATASETS_PAGE}/{dataset}."
    )


def _download(dataset: str, root: Path) -> None:
    try:
        # This import asks the internet for the list of data sets, so it comes last.
        datasets = require("causalchamber.datasets")
        _warn_if_changed(dataset, datasets)
        root.mkdir(parents=True, exist_ok=True)
        # Downloaded, checked against its MD5 sum and unpacked beside its place, and
        # moved there whole: what a download cut off half-way leaves is never taken
        # for data.
        with tempfile.TemporaryDirectory(prefix=".download_", dir=root) as folder:
            datasets.Dataset(dataset, root=folder, download=True)
            (Path(folder) / dataset).rename(root / dataset)
    except ImportError:
        raise
    except Exception as error:  # of the network, the archive or the disk
        raise DataNotFoundError(
            f"Could not download {dataset}: {type(error).__name__}: {error}. Nothing "
            f"of it was kept. Try again, or download and unpack it into {root} from "
            f"{DATASETS_PAGE}/{dataset}."
        ) from error


def _warn_if_changed(dataset: str, datasets: ModuleType) -> None:
    # The package checks an archive against the sum in its own, current list only.
    listed = getattr(datasets, "directory", {}).get("datasets", {})
    published = listed.get(dataset, {}).get("md5")
    known = KNOWN_ARCHIVES.get(dataset)
    if known and published and published != known:
        warn_user(
            f"The published data set {dataset} has changed since this task was written "
            f"(MD5 sum {published}; {known} was known): results may differ from those "
            "of other users."
        )


def require(module: str) -> ModuleType:
    """Import an optional package, or say how to install it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"Recorded data need {module}. Install it with "
            f'`pip install "sbi-rope[benchmarks]"`.'
        ) from error
