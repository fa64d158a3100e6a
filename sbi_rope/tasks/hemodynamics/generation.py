"""Makes data sets of many people in parallel, and goes on after an interrupt."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sbi_rope._files import write_atomically
from sbi_rope._progress import progress_bar
from sbi_rope.errors import InvalidInputError, SimulationError
from sbi_rope.settings import Count, Whole, check, one_of
from sbi_rope.tasks.hemodynamics.chunks import Simulate, Work, read_part, run_chunk
from sbi_rope.tasks.hemodynamics.dataset import (
    COLUMNS,
    FORMAT_VERSION,
    BeatSet,
    load,
)
from sbi_rope.tasks.hemodynamics.population import (
    NUISANCES,
    PROCESSES,
    Population,
    Process,
)
from sbi_rope.tasks.hemodynamics.store import write_arrays
from sbi_rope.tasks.hemodynamics.subject import Physics

__all__ = ["generate"]

CHUNK_SIZE = 20  # people in a file of the working folder, some ten seconds of work
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
    simulate: Simulate | None = None,
    progress: bool = True,
) -> BeatSet:
    """Simulate the first ``n`` people of a cohort that can be simulated.

    Work in progress lies in the folder ``<path>.parts``. After an interrupt, the same
    call goes on from there. The file has the same bytes for the same settings,
    whatever the number of jobs and of interrupts.

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
        simulate: Function of a :class:`Subject` and :class:`Physics` that returns a
            :class:`Beat` or raises a :class:`SimulationError`; picklable, and the
            same after an interrupt. By default ``simulate_beat``.
        progress: Whether to show a bar with the time left.

    Returns:
        The data set, as read from the file.

    Raises:
        InvalidInputError: If the file is there, work in progress has other settings,
            or an argument is out of range.
        SimulationError: If nearly nobody can be simulated.
        ImportError: If numba is not installed.
    """
    path = Path(path).expanduser()
    if path.exists():
        raise InvalidInputError(f"Expected no file {path} yet; got one.")
    check("n", n, Count)
    check("seed", seed, Whole)
    check("process", process, one_of(PROCESSES))
    work = Work(
        process=process,
        seed=int(seed),
        population=population or Population(),
        physics=physics or Physics(),
        simulate=simulate or _default_simulate(),
        folder=path.with_name(f"{path.name}.parts"),
    )
    settings = {
        "format": FORMAT_VERSION,
        # Imported long ago; at the top of this module it would close a circle.
        "version": import_module("sbi_rope").__version__,
        "process": process,
        "n": int(n),
        "seed": int(seed),
        # The lengths of arteries only matter for the real process.
        "population": asdict(work.population)
        if process == "real"
        else {"prior": work.population.prior},
        "physics": asdict(work.physics),
    }
    _claim(work.folder, settings)
    parts = _simulate_all(work, n, jobs, progress=progress)
    write_arrays(path, _assemble(parts, n, settings))
    _remove(work.folder)
    return load(path)


# Running -----------------------------------------------------------------------------


def _default_simulate() -> Simulate:
    if find_spec("numba") is None:  # before any work begins
        raise ImportError(
            "Simulating blood flow needs numba. Install it with "
            '`pip install "sbi-rope[hemodynamics]"`.'
        )
    from sbi_rope.tasks.hemodynamics.waveforms import simulate_beat

    return simulate_beat


def _simulate_all(
    work: Work, n: int, jobs: int | None, *, progress: bool
) -> list[dict[str, np.ndarray]]:
    """Return the parts, in order of people, with ``n`` that were accepted."""
    parts: list[dict[str, np.ndarray]] = []
    tried = accepted = 0
    done = [read_part(file) for file in work.folder.glob("part_*.npz")]
    bar = progress_bar(
        total=n,
        # From before an interrupt: not work that the time left is judged by.
        initial=sum(len(part["index"]) for part in done if part is not None),
        unit="people",
        smoothing=0.1,
        show=progress,
        desc="Simulating",
    )
    with bar:
        while accepted < n:
            # Those who are rejected are replaced by as many further people. The
            # chunks follow from `n` and the results alone, so they are the same when
            # the work is taken up again.
            stop = tried + n - accepted
            chunks = [
                range(start, min(start + CHUNK_SIZE, stop))
                for start in range(tried, stop, CHUNK_SIZE)
            ]
            _run(work, chunks, jobs, bar)
            new = [read_part(work.part(chunk)) for chunk in chunks]
            tried, parts = stop, parts + [part for part in new if part is not None]
            accepted = sum(len(part["index"]) for part in parts)
            if tried - accepted > MAX_REJECTED + accepted:
                raise SimulationError(
                    f"Of {tried} people, {tried - accepted} could not be simulated: "
                    f"{_count_reasons(parts)}. Use other physics settings."
                )
    return parts


def _run(work: Work, chunks: list[range], jobs: int | None, bar: Any) -> None:
    todo = [chunk for chunk in chunks if read_part(work.part(chunk)) is None]
    rejected = 0
    for accepted, failed in _parallel(work, todo, jobs):
        bar.update(accepted)
        rejected += failed
        if rejected:
            bar.set_postfix(rejected=rejected)


def _parallel(
    work: Work, chunks: list[range], jobs: int | None
) -> Iterable[tuple[int, int]]:
    import joblib

    calls: Iterator[Any] = (joblib.delayed(run_chunk)(work, chunk) for chunk in chunks)
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
    return parallel(calls)  # type: ignore[return-value]


# Files -------------------------------------------------------------------------------


def _claim(folder: Path, settings: dict[str, Any]) -> None:
    """Begin a working folder, or make sure that it is one of the same work."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "settings.json"
    if not file.exists():
        with write_atomically(file) as temporary:
            temporary.write_text(json.dumps(settings, indent=1), encoding="utf-8")
    found = json.loads(file.read_text(encoding="utf-8"))
    if found != settings:
        raise InvalidInputError(
            f"Expected the unfinished work in {folder} to be of {settings}; got "
            f"{found}. Remove it, or choose another name."
        )


def _assemble(
    parts: list[dict[str, np.ndarray]], n: int, settings: dict[str, Any]
) -> dict[str, np.ndarray]:
    filled = [part for part in parts if len(part["index"])]
    names = [*COLUMNS]
    if settings["process"] == "real":
        names.append("length_factors")
    arrays = {name: np.concatenate([part[name] for part in filled]) for name in names}
    header = {"settings": settings, "rejected": _count_reasons(parts)}
    arrays["nuisance_names"] = np.array(NUISANCES)
    arrays["settings"] = np.array(json.dumps(header, sort_keys=True))
    return arrays


def _count_reasons(parts: list[dict[str, np.ndarray]]) -> dict[str, int]:
    lines = (line for part in parts for line in json.loads(str(part["rejected"])))
    return dict(sorted(Counter(line.split(" ", 1)[1] for line in lines).items()))


def _remove(folder: Path) -> None:
    done = [*folder.glob("part_*.npz"), *folder.glob(".part_*.tmp")]
    for file in [*done, folder / "settings.json"]:
        file.unlink(missing_ok=True)
    try:
        folder.rmdir()
    except OSError:  # somebody else's files are in it
        return
