"""Makes data sets of many people, in parallel."""

import json
import re
from collections import Counter
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from sbi_rope.tasks.hemodynamics.dataset import FORMAT_VERSION, BeatSet, load
from sbi_rope.tasks.hemodynamics.population import (
    NUISANCES,
    PROCESSES,
    Population,
    Process,
)
from sbi_rope.tasks.hemodynamics.subject import Physics
from sbi_rope.tasks.hemodynamics.waveforms import simulate_beat
from sbi_rope.utils.errors import InvalidInputError, SimulationError
from sbi_rope.utils.files import write_atomically
from sbi_rope.utils.progress import progress_bar
from sbi_rope.utils.settings import Count, Whole, check, one_of

# A process that rejects this many more people than it accepts is not worth the wait.
MAX_REJECTED = 200


def generate(
    path: str | Path,
    *,
    n: int,
    process: Process,
    seed: int = 0,
    population: Population | None = None,
    physics: Physics | None = None,
    jobs: int | None = None,
    progress: bool = True,
) -> BeatSet:
    """Simulate the first ``n`` people of a cohort that can be simulated.

    The file has the same bytes for the same settings, whatever the number of jobs.

    Args:
        path: The npz file to write. It must not be there yet.
        n: Number of people.
        process: ``"simulator"`` or ``"real"``.
        seed: Number of the cohort. People of different cohorts are independent.
        population: The law that people are drawn from.
        physics: The settings to solve the equations with.
        jobs: Number of jobs of joblib, -1 for as many as there are cores; unless
            given, that of the surrounding ``joblib.parallel_config``, the backend of
            which is used in any case.
        progress: Whether to show a bar with the time left.

    Returns:
        The data set, as read from the file.

    Raises:
        InvalidInputError: If the file is there, or an argument is out of range.
        SimulationError: If nearly nobody can be simulated.
        ImportError: If numba is not installed.
    """
    path = Path(path).expanduser()
    if path.exists():
        raise InvalidInputError(f"Expected no file {path} yet; got one.")
    check("n", n, Count)
    check("seed", seed, Whole)
    check("process", process, one_of(PROCESSES))
    population, physics = population or Population(), physics or Physics()
    cohort = (population, physics, process, int(seed))
    people, rejected = _simulate_all(cohort, n, jobs, progress=progress)
    settings = {
        "format": FORMAT_VERSION,
        # Imported long ago; at the top of this module it would close a circle.
        "version": metadata.version("sbi-rope"),
        "process": process,
        "n": int(n),
        "seed": int(seed),
        # It says how long arteries are, which is the same in the simulator.
        "population": asdict(population) if process == "real" else {},
        "physics": asdict(physics),
    }
    header = {"settings": settings, "rejected": rejected}
    arrays = {name: np.stack([person[name] for person in people]) for name in people[0]}
    arrays["nuisance_names"] = np.array(NUISANCES)
    arrays["settings"] = np.array(json.dumps(header, sort_keys=True))
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return load(path)


def _simulate_all(
    cohort: tuple[Population, Physics, Process, int],
    n: int,
    jobs: int | None,
    *,
    progress: bool,
) -> tuple[list[dict[str, np.ndarray]], dict[str, int]]:
    """Return ``n`` people, and how many could not be simulated for each reason."""
    people: list[dict[str, np.ndarray]] = []
    reasons: Counter[str] = Counter()
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator")
    bar = progress_bar(
        total=n, unit="people", smoothing=0.1, show=progress, desc="Simulating"
    )
    with bar:
        while len(people) < n:
            # Those who are rejected are replaced by as many further people.
            tried = len(people) + reasons.total()
            indices = range(tried, tried + n - len(people))
            calls = [joblib.delayed(_simulate)(*cohort, index) for index in indices]
            results: Any = parallel(calls)
            for person in results:
                if isinstance(person, str):
                    reasons[person] += 1
                    bar.set_postfix(rejected=reasons.total())
                else:
                    people.append(person)
                    bar.update(1)
            if reasons.total() > MAX_REJECTED + len(people):
                raise SimulationError(
                    f"{reasons.total()} people could not be simulated, and "
                    f"{len(people)} could: {dict(reasons)}. Use other physics settings."
                )
    return people, dict(sorted(reasons.items()))


def _simulate(
    population: Population, physics: Physics, process: Process, seed: int, index: int
) -> dict[str, np.ndarray] | str:
    """Return a person's row of the data set, or why there is none."""
    subject = population.draw(process, seed, index)
    try:
        beat = simulate_beat(subject, physics)
    except SimulationError as error:
        sentence = re.split(r"[.;:](?:\s|$)", str(error), maxsplit=1)[0]
        return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", sentence)
    columns: dict[str, Any] = {
        "beat": beat.pressure["radial"],
        "period": beat.period,
        "theta": (subject.stroke_volume, subject.ejection_time),
        "nuisance": [getattr(subject, name) for name in NUISANCES],
        "period_error": beat.period_error,
        "mass_error": beat.mass_error,
        "courant": beat.courant,
    }
    row: dict[str, np.ndarray] = {
        name: np.asarray(value, np.float32) for name, value in columns.items()
    }
    row["index"] = np.asarray(index, np.int64)
    if process == "real":
        row["length_factors"] = np.asarray(subject.length_factors, np.float32)
    return row
