"""Files of a few people each, in which a data set is made."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sbi_rope.errors import SimulationError
from sbi_rope.tasks.hemodynamics.dataset import COLUMNS
from sbi_rope.tasks.hemodynamics.population import NUISANCES, Population, Process
from sbi_rope.tasks.hemodynamics.store import read_arrays, write_arrays
from sbi_rope.tasks.hemodynamics.subject import Beat, Physics, Subject

__all__ = ["Simulate", "Work", "read_part", "run_chunk"]

Simulate = Callable[[Subject, Physics], Beat]


@dataclass(frozen=True, kw_only=True)
class Work:
    """The people to simulate, how, and the folder for unfinished work.

    Attributes:
        process: ``"simulator"`` or ``"real"``.
        seed: Number of the cohort.
        population: The law that people are drawn from.
        physics: The settings to solve the equations with.
        simulate: Returns the beat of a subject.
        folder: Folder for parts of the work.
    """

    process: Process
    seed: int
    population: Population
    physics: Physics
    simulate: Simulate
    folder: Path

    def part(self, chunk: range) -> Path:
        """Return the file of a chunk of people."""
        return self.folder / f"part_{chunk.start:08d}_{chunk.stop:08d}.npz"


def run_chunk(work: Work, chunk: range) -> tuple[int, int]:
    """Simulate a few people, write them to a file, return accepted and rejected."""
    rows: list[tuple[int, Subject, Beat]] = []
    reasons: list[str] = []
    for index in chunk:
        subject = work.population.draw(work.process, work.seed, index)
        try:
            beat = work.simulate(subject, work.physics)
            if not np.isfinite(beat.pressure["radial"]).all():
                raise SimulationError("The pressures are not finite.")
        except SimulationError as error:
            reasons.append(f"{index} {_reason(str(error))}")
        else:
            rows.append((index, subject, beat))
    arrays = _arrays(rows, work.process)
    arrays["rejected"] = np.array(json.dumps(reasons))
    work.folder.mkdir(parents=True, exist_ok=True)
    write_arrays(work.part(chunk), arrays)
    return len(rows), len(reasons)


def read_part(file: Path) -> dict[str, np.ndarray] | None:
    """Return the people of a chunk, or None if they are still to be simulated."""
    try:
        arrays = read_arrays(file)
        people = arrays["index"].tolist()
        people += [int(line.split()[0]) for line in json.loads(str(arrays["rejected"]))]
    except (ValueError, KeyError):  # not there, or broken: then it is made again
        return None
    # A part that was renamed or copied would let the same people in twice.
    expected = list(range(*map(int, file.stem.split("_")[1:])))
    complete = set(COLUMNS) <= set(arrays) and sorted(people) == expected
    return arrays if complete else None


def _arrays(
    rows: list[tuple[int, Subject, Beat]], process: Process
) -> dict[str, np.ndarray]:
    columns: dict[str, list[Any]] = {
        "beat": [beat.pressure["radial"] for _, _, beat in rows],
        "period": [beat.period for _, _, beat in rows],
        "theta": [(s.stroke_volume, s.ejection_time) for _, s, _ in rows],
        "nuisance": [[getattr(s, name) for name in NUISANCES] for _, s, _ in rows],
        "period_error": [beat.period_error for _, _, beat in rows],
        "mass_error": [beat.mass_error for _, _, beat in rows],
        "courant": [beat.courant for _, _, beat in rows],
        "index": [index for index, _, _ in rows],
    }
    if process == "real":
        columns["length_factors"] = [s.length_factors for _, s, _ in rows]
    return {
        name: np.asarray(column, dtype=np.int64 if name == "index" else np.float32)
        for name, column in columns.items()
    }


def _reason(message: str) -> str:
    """Return the first sentence of a message, without its numbers."""
    sentence = re.split(r"[.;:](?:\s|$)", message, maxsplit=1)[0]
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", sentence)
