"""Stored beats of simulated people, and how to read them."""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.tasks.hemodynamics.population import Process
from sbi_rope.utils.errors import DataNotFoundError, InvalidInputError

FORMAT_VERSION = 1
COMMAND = "python -m sbi_rope.tasks.hemodynamics generate"
# The arrays with a row for each person.
COLUMNS = (
    *("beat", "period", "theta", "nuisance", "period_error", "mass_error"),
    *("courant", "index"),
)
# What NumPy raises for a file that is cut off or holds no such arrays.
BROKEN = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


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
            ``(n, k)``, float32, in the order of ``NUISANCES``.
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


def load(path: str | Path, *, process: Process | None = None) -> BeatSet:
    """Read a data set, of one process if it is given.

    Raises:
        DataNotFoundError: If there is no such file.
        InvalidInputError: If it is another kind of file, of another version, or of the
            other process.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise DataNotFoundError(f"No file {path}. Make it with `{COMMAND}`.")
    try:
        with np.load(path) as archive:  # runs no code that the file may hold
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays.pop("settings")))
        settings = header["settings"]
        if settings["format"] != FORMAT_VERSION:
            raise ValueError(f"of format {settings['format']}")
        if process is not None and settings["process"] != process:
            raise ValueError(f"of the process {settings['process']!r}")
        tensors = {name: torch.from_numpy(arrays[name]) for name in COLUMNS}
    except BROKEN as error:
        raise InvalidInputError(
            f"Expected {path} to be pressure waves of {process or 'any process'} in "
            f"format {FORMAT_VERSION}; got a file that is not ({error})."
        ) from error
    lengths = arrays.get("length_factors")
    return BeatSet(
        **tensors,
        length_factors=None if lengths is None else torch.from_numpy(lengths),
        settings=settings,
        rejected=header["rejected"],
    )
