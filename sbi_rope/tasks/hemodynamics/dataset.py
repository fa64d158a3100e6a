"""Stored beats of simulated people, and how to read them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope._files import read_arrays
from sbi_rope._validation import check_path
from sbi_rope.errors import DataNotFoundError, InvalidInputError
from sbi_rope.settings import check, one_of
from sbi_rope.tasks.hemodynamics.population import (
    NUISANCES,
    PROCESSES,
    Population,
    Process,
)
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Physics

__all__ = ["FORMAT_VERSION", "BeatSet", "describe_population", "differences", "load"]

FORMAT_VERSION = 1
COMMAND = "python -m sbi_rope.tasks.hemodynamics generate"
SETTINGS = ("format", "version", "process", "n", "seed", "population", "physics")
# Lengths of a beat in s, of hearts that beat 30 to 200 times in a minute.
SHORTEST, LONGEST = 0.3, 2.0
# Columns of the arrays with a row for each person; 0 for plain numbers.
COLUMNS = {
    "beat": 256,
    "period": 0,
    "theta": 2,
    "nuisance": len(NUISANCES),
    "period_error": 0,
    "mass_error": 0,
    "courant": 0,
    "index": 0,
}


@dataclass(frozen=True, kw_only=True)
class BeatSet:
    """Beats of ``n`` people and the settings they were made with, on the CPU.

    Attributes:
        beat: Pressure at the left wrist over one beat, in mmHg, at 256 equally spaced
            times from the opening of the aortic valve, end excluded, shape
            ``(n, 256)``, float32.
        period: Length of the beat in s, shape ``(n,)``, float32.
        theta: Stroke volume in ml and ejection time in ms, shape ``(n, 2)``, float32.
        nuisance: All else about a person, in the units of :class:`Subject`, shape
            ``(n, k)``, float32.
        nuisance_names: Names of the ``k`` columns.
        length_factors: Lengths of the segments relative to the table, shape
            ``(n, 116)``, float32; None from the simulator, where all are 1.
        period_error: Largest difference between the last two beats in mmHg, shape
            ``(n,)``, float32.
        mass_error: Relative difference of what flows in and out in the last beat,
            shape ``(n,)``, float32.
        courant: Courant number of the run, shape ``(n,)``, float32.
        index: Number of each person in the cohort, shape ``(n,)``, int64, increasing.
        settings: What the set was made with: ``format``, ``version`` of the package,
            ``process``, ``n``, ``seed``, ``population``, ``physics``.
        rejected: How many people could not be simulated, by reason. The next ones of
            the cohort are in their place.
    """

    beat: Tensor
    period: Tensor
    theta: Tensor
    nuisance: Tensor
    nuisance_names: tuple[str, ...]
    length_factors: Tensor | None
    period_error: Tensor
    mass_error: Tensor
    courant: Tensor
    index: Tensor
    settings: dict[str, Any]
    rejected: dict[str, int]

    def __len__(self) -> int:
        """Return the number of people."""
        return len(self.theta)


def load(
    path: str | Path,
    *,
    process: Process | None = None,
    population: Population | None = None,
    physics: Physics | None = None,
) -> BeatSet:
    """Read a data set, and check that it is whole and the one that was asked for.

    Args:
        path: A file that ``python -m sbi_rope.tasks.hemodynamics generate`` made.
        process: The process that it should be of. Unless given, any will do.
        population: The population that it should be of; any, unless given. The
            lengths of arteries only matter for the real process.
        physics: The discretisation that it should be made with; any, unless given.

    Raises:
        DataNotFoundError: If there is no such file.
        InvalidInputError: If it is another kind of file, of another version, broken,
            or made with other settings.
    """
    path = Path(str(check_path("path", path)))
    check("population", population, Population | None)
    check("physics", physics, Physics | None)
    if not path.is_file():
        raise DataNotFoundError(f"No file {path}. Make it with `{COMMAND}`.")
    try:
        arrays = read_arrays(path)
        header = json.loads(str(arrays.pop("settings")))
        settings, rejected = header["settings"], header["rejected"]
        found = settings["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(
            f"Expected {path} to be a data set of pressure waves; got a file that is "
            f"none, or is cut ({error}). {_again(path)}"
        ) from error
    if found != FORMAT_VERSION:
        raise InvalidInputError(
            f"Expected {path} in format {FORMAT_VERSION}; got format {found!r}, of "
            f"another version of this package. {_again(path)}"
        )
    _check_settings(path, settings, process, population, physics)
    _check_arrays(path, arrays, settings)
    lengths = arrays["length_factors"] if settings["process"] == "real" else None
    return BeatSet(
        **{name: torch.from_numpy(arrays[name]) for name in COLUMNS},
        nuisance_names=NUISANCES,
        length_factors=None if lengths is None else torch.from_numpy(lengths),
        settings=settings,
        rejected=rejected,
    )


def describe_population(population: Population, process: Process) -> dict[str, Any]:
    """Return the settings that matter for a process, lengths for the real one only."""
    settings = population.as_dict()
    return settings if process == "real" else {"prior": settings["prior"]}


def differences(found: dict[str, Any], asked: dict[str, Any]) -> str:
    """Return in words which settings are not those asked for, if there are any."""
    words = []
    for name, value in asked.items():
        other = found.get(name)
        if isinstance(value, dict) and isinstance(other, dict):
            words.append(differences(other, value))
        elif other != value:
            words.append(f"{name} is {other!r} instead of {value!r}")
    return ", ".join(filter(None, words))


def _check_settings(
    path: Path,
    settings: dict[str, Any],
    process: Process | None,
    population: Population | None,
    physics: Physics | None,
) -> None:
    missing = [name for name in SETTINGS if name not in settings]
    unusable = [] if missing else _unusable(settings)
    if missing or unusable:
        raise InvalidInputError(
            f"Expected {path} to say with which settings it was made; {missing} are "
            f"missing, {unusable} are no such settings. {_again(path)}"
        )
    asked: dict[str, Any] = {}
    if process is not None:
        check("process", process, one_of(PROCESSES))
        asked["process"] = process
    if population is not None:
        asked["population"] = describe_population(population, settings["process"])
    if physics is not None:
        asked["physics"] = physics.as_dict()
    wrong = differences(settings, asked)
    if wrong:
        raise InvalidInputError(
            f"Expected {path} to be made with the settings asked for; {wrong}. Ask for "
            f"those of the file, or make another one with `{COMMAND}`."
        )


def _unusable(settings: dict[str, Any]) -> list[str]:
    """Return the names of settings that are not of their kind."""
    population, physics = settings["population"], settings["physics"]
    usable = {
        "process": any(settings["process"] == process for process in PROCESSES),
        "population": isinstance(population, dict) and "prior" in population,
        "physics": isinstance(physics, dict)
        and Physics().as_dict().keys() <= {*physics},
    }
    return [name for name, is_usable in usable.items() if not is_usable]


def _check_arrays(
    path: Path, arrays: dict[str, np.ndarray], settings: dict[str, Any]
) -> None:
    columns = dict(COLUMNS)
    if settings["process"] == "real":
        columns["length_factors"] = NUM_SEGMENTS
    n = settings["n"]
    for name, width in columns.items():
        shape = (n, width) if width else (n,)
        dtype = np.dtype(np.int64 if name == "index" else np.float32)
        array = arrays.get(name)
        if array is None or array.shape != shape or array.dtype != dtype:
            got = "none" if array is None else f"{array.dtype} of shape {array.shape}"
            raise InvalidInputError(
                f"Expected the array `{name}` of {path} to be {dtype} of shape "
                f"{shape}; got {got}. {_again(path)}"
            )
        if not np.isfinite(array).all():
            raise InvalidInputError(
                f"Expected the array `{name}` of {path} to be finite; got NaN or Inf. "
                f"{_again(path)}"
            )
    _check_people(path, arrays)
    names = tuple(np.atleast_1d(arrays.get("nuisance_names", ())).tolist())
    if names != NUISANCES:
        raise InvalidInputError(
            f"Expected {path} to have the nuisance parameters {NUISANCES}; got "
            f"{names}. {_again(path)}"
        )


def _check_people(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise if a person is in the set twice, or has a beat that cannot be recorded."""
    beat, period, index = arrays["beat"], arrays["period"], arrays["index"]
    wrong = {
        "a `beat` that does not vary": beat.min(axis=1) == beat.max(axis=1),
        "a `period` that no heart has": ~((period >= SHORTEST) & (period <= LONGEST)),
        "an `index` not above that of the person before": np.diff(index, prepend=-1)
        < 1,
    }
    for what, rows in wrong.items():
        if rows.any():
            raise InvalidInputError(
                f"Expected a set of different people in {path}; {int(rows.sum())} of "
                f"{len(rows)} rows have {what} (first: row {int(rows.argmax())}). "
                f"{_again(path)}"
            )


def _again(path: Path) -> str:
    return f"Remove {path.name} and make it again with `{COMMAND}`."
