"""How long does a stack take?

The table of "A stack: how fast" of `benchmarks/speed.md`. NPE is trained once for each
task, with the `standard` preset. Every row is a process of its own. With ``--before``
each row is measured on another checkout of the package too, in turns; compare within a
run. The last column is the held-out score, in standard deviations of the prior: it
shows whether both find the same.

    python -m benchmarks.experiments.stacking --root FOLDER --before ../old-checkout

Images of `light_tunnel` are recorded ones only if FOLDER has them. Otherwise they are
those of a right simulator.
"""

import argparse
import itertools
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.experiments.common import BEFORE, Row, begin, measured, show, versions

COLUMNS = ("task", "pairs", "version", "CPU s", "score")
TASKS = [
    *("linear_gaussian", "cs", "sir", "light_tunnel_sensors", "pendulum"),
    *("hemodynamics", "light_tunnel"),
]
OPTIONS = {
    "--task": {"nargs": "+", "default": TASKS},
    "--n-calibration": {"nargs": "+", "type": int, "default": [50]},
    "--root": {"type": Path, "help": "folder of the chambers' recordings"},
    "--cache": {"type": Path, "help": "where trained NPEs are kept between runs"},
    **BEFORE,
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row for each task, number of pairs and version."""
    with tempfile.TemporaryDirectory() as folder:
        cache = args.cache or Path(folder)
        for task, n in itertools.product(args.task, args.n_calibration):
            path = Path(folder) / "case.pt"
            torch.save(prepared(task, n, args.root, cache), path)
            for version, root in versions(args.before).items():
                settings = {"task": task, "pairs": n, "version": version, "root": root}
                settings |= {"case": path, "threads": args.threads}
                row = settings | measured("stacking", settings)
                yield {column: row[column] for column in COLUMNS}


def prepared(task: str, n: int, root: Path | None, cache: Path) -> dict[str, Any]:
    """Return the trained NPE of a task, its pairs, and where simulations come from."""
    from benchmarks.cases import Case, Sources
    from benchmarks.cells import Cell

    has_images = root is not None and (root / "lt_camera_v1").is_dir()
    cell = Cell(
        task=task,
        variant="well_specified" if task == "light_tunnel" and not has_images else "",
        method="stack",
        preset="standard",
        n_calibration=n,
        repetition=0,
        options="{}",
    )
    case = Case.of(cell, Sources(root=root), cache, "cpu")
    return {
        "posterior": case.npe,
        "pairs": case.calibration,
        # Each version of the package has a simulator of its own.
        "task": {"variant": cell.variant or None, "root": root},
        "simulations": case.stored if case.simulator is None else None,
        "unit": float(case.task.prior_std.log().sum()),
    }


def measure(settings: dict[str, Any]) -> None:
    """Measure a stack with the package of a checkout and print it as JSON."""
    sys.path.insert(0, settings["root"])
    from sbi_rope import RoPE, stack
    from sbi_rope.tasks import get_task

    warnings.simplefilter("ignore")
    torch.set_num_threads(settings["threads"])
    # This file was written by the process that started this one.
    case = torch.load(settings["case"], weights_only=False)
    source: dict[str, Any] = {"simulations": case["simulations"]}
    if case["simulations"] is None:
        task = get_task(settings["task"], **case["task"])
        source = {"simulator": task.get_simulator()}
    rope = RoPE(case["posterior"], **source).append_calibration(*case["pairs"])
    start = time.process_time()
    posterior = stack(rope, seed=0, show_progress_bars=False)
    seconds = time.process_time() - start
    score = posterior.report.held_out.lpp.mean
    found = {"CPU s": f"{seconds:.0f}", "score": f"{float(score) + case['unit']:.2f}"}
    print(json.dumps(found))


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        measure(json.loads(sys.argv[1]))
    else:
        show(rows(begin(__doc__, OPTIONS, threads=1)))
