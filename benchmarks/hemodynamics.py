"""How long a beat of the arteries takes.

Prints one Markdown table: seconds a person by length of cells, for elastic and
viscoelastic walls, on one core and on all; and how long the solver takes to compile the
first time. Wall times and the scaling are those of the cores that are free: where the
CPU seconds of all jobs are those of one, jobs do not slow each other down. People are
those of the simulator's population. Compiled code is kept next to the package; its
compilation is measured in a process with an empty cache.

    python -m benchmarks.hemodynamics
    python -m benchmarks.hemodynamics --people 20 --cell-lengths 0.01
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from itertools import product

from joblib import Parallel, delayed

from benchmarks.machine import describe_machine
from sbi_rope.errors import SimulationError
from sbi_rope.tasks.hemodynamics.grid import build_grid
from sbi_rope.tasks.hemodynamics.network import build_network
from sbi_rope.tasks.hemodynamics.population import Population
from sbi_rope.tasks.hemodynamics.subject import Physics, Subject
from sbi_rope.tasks.hemodynamics.validation import BASELINE
from sbi_rope.tasks.hemodynamics.waveforms import simulate_beat

COMPILE = """
import time
from sbi_rope.tasks.hemodynamics.validation import BASELINE
from sbi_rope.tasks.hemodynamics.subject import Physics
from sbi_rope.tasks.hemodynamics.waveforms import simulate_beat
start = time.perf_counter()
simulate_beat(BASELINE, Physics(cell_length=0.02))
print(time.perf_counter() - start)
"""


def main() -> None:
    """Print the compile time and one row a setting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--cell-lengths", type=float, nargs="+", default=[0.02, 0.01, 0.005]
    )
    args = parser.parse_args()
    print(f"{describe_machine(threads=1)}, numba {version('numba')}", end="\n\n")
    print(f"Compiling, once: {compile_seconds():.1f} s", end="\n\n")
    print(
        f"| cell cm | walls | points | CPU s, 1 job | CPU s, {args.jobs} jobs | "
        f"wall s, 1 job | wall s, {args.jobs} jobs | scaling | rejected |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    population = Population()
    people = [population.draw("simulator", 0, i) for i in range(args.people)]
    for row in rows(people, args.cell_lengths, args.jobs):
        print(f"| {' | '.join(row)} |", flush=True)


def rows(
    people: list[Subject], cell_lengths: list[float], jobs: int
) -> Iterator[list[str]]:
    """Measure each setting, after a beat that is not counted."""
    for cell_length, viscoelastic in product(cell_lengths, (False, True)):
        physics = Physics(cell_length=cell_length, viscoelastic=viscoelastic)
        simulate_beat(BASELINE, physics)
        single = [simulate(subject, physics) for subject in people]
        cpu, alone, failed = (sum(column) for column in zip(*single, strict=True))
        busy, together = parallel_seconds(people, physics, jobs)
        yield [
            f"{100 * cell_length:g}",
            "viscoelastic" if viscoelastic else "elastic",
            str(len(build_grid(build_network(BASELINE, physics), cell_length).slope)),
            f"{cpu / len(people):.3f}",
            f"{busy / len(people):.3f}",
            f"{alone / len(people):.3f}",
            f"{together / len(people):.3f}",
            f"{alone / (together * jobs):.2f}",
            str(failed),
        ]


def simulate(subject: Subject, physics: Physics) -> tuple[float, float, int]:
    """Return CPU and wall seconds of a beat, and 1 if there is none."""
    cpu, wall, failed = time.process_time(), time.perf_counter(), 0
    try:
        simulate_beat(subject, physics)
    except SimulationError:
        failed = 1
    return time.process_time() - cpu, time.perf_counter() - wall, failed


def parallel_seconds(
    people: list[Subject], physics: Physics, jobs: int
) -> tuple[float, float]:
    """Return CPU and wall seconds of all people in processes that are up already."""
    with Parallel(n_jobs=jobs, batch_size=1) as parallel:
        # Imports take seconds: wait for every process to have simulated something.
        seen: set[int] = set()
        while len(seen) < jobs:
            seen.update(parallel(delayed(warm_up)(physics) for _ in range(4 * jobs)))
        start = time.perf_counter()
        done = parallel(delayed(simulate)(subject, physics) for subject in people)
        return sum(cpu for cpu, _, _ in done), time.perf_counter() - start


def warm_up(physics: Physics) -> int:
    """Simulate a beat and return the process that did."""
    simulate_beat(BASELINE, physics)
    return os.getpid()


def compile_seconds() -> float:
    """Return the seconds to the first beat of a process that has nothing compiled."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", COMPILE],
            env={**os.environ, "NUMBA_CACHE_DIR": folder},
            capture_output=True,
            text=True,
            check=True,
        )
    return float(done.stdout)


if __name__ == "__main__":
    main()
