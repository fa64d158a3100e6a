"""How long does a beat of the arteries take?

The table "Blood flow: how fast" of `benchmarks/speed.md`: seconds a person by length
of cells, for elastic and viscoelastic walls, on one core and on all; and how long the
solver takes to compile the first time. Wall times and the scaling are those of the
cores that are free: where the CPU seconds of all jobs are those of one, jobs do not
slow each other down. Compilation is measured in a process with an empty cache.

    python -m benchmarks.experiments.hemodynamics
    python -m benchmarks.experiments.hemodynamics --people 20 --cell-lengths 0.01
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

from benchmarks.experiments.common import Row, begin, show
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


OPTIONS = {
    "--people": {"type": int, "default": 50},
    "--jobs": {"type": int, "default": os.cpu_count() or 1},
    "--cell-lengths": {"type": float, "nargs": "+", "default": [0.02, 0.01, 0.005]},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Measure each setting, after a beat that is not counted."""
    print(f"numba {version('numba')}; compiling, once: {compile_seconds():.1f} s\n")
    population, jobs = Population(), args.jobs
    people = [population.draw("simulator", 0, i) for i in range(args.people)]
    for cell_length, viscoelastic in product(args.cell_lengths, (False, True)):
        physics = Physics(cell_length=cell_length, viscoelastic=viscoelastic)
        simulate_beat(BASELINE, physics)
        single = [simulate(subject, physics) for subject in people]
        cpu, alone, failed = (sum(column) for column in zip(*single, strict=True))
        busy, together = parallel_seconds(people, physics, jobs)
        grid = build_grid(build_network(BASELINE, physics), cell_length)
        seconds = {
            "CPU s, 1 job": cpu,
            f"CPU s, {jobs} jobs": busy,
            "wall s, 1 job": alone,
            f"wall s, {jobs} jobs": together,
        }
        yield {
            "cell cm": f"{100 * cell_length:g}",
            "walls": "viscoelastic" if viscoelastic else "elastic",
            "points": len(grid.slope),
            **{name: f"{value / len(people):.3f}" for name, value in seconds.items()},
            "scaling": f"{alone / (together * jobs):.2f}",
            "rejected": failed,
        }


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
    show(rows(begin(__doc__, OPTIONS, threads=1)))
