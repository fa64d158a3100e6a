"""What the experiments share: options, data, and how a table is printed."""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.machine import describe_machine

# Nothing of the package is imported here: `mixture` and `stacking` choose later which
# version of it is measured.

__all__ = [
    "BEFORE",
    "Options",
    "Row",
    "begin",
    "measured",
    "show",
    "versions",
]

ROOT = Path(__file__).resolve().parents[2]

# Options of the command line, with what argparse is to know of them.
Options = dict[str, Mapping[str, Any]]
Row = Mapping[str, object]
# To compare two versions of the package.
BEFORE: Options = {
    "--before": {"type": Path, "help": "another checkout to measure too"}
}


def begin(
    doc: str | None, options: Options, *, threads: int | None = None
) -> argparse.Namespace:
    """Read the options of an experiment, and say what it is run on.

    Args:
        doc: What the experiment is about.
        options: Its own options; ``--threads`` is added.
        threads: Threads if none are asked for; those of torch if None.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, settings in options.items():
        parser.add_argument(name, **settings)
    parser.add_argument("--threads", type=int, default=threads)
    args = parser.parse_args()
    if args.threads is None:
        args.threads = torch.get_num_threads()
    torch.set_num_threads(args.threads)
    print(f"{describe_machine(threads=args.threads)}\n", flush=True)
    return args


def versions(before: Path | None) -> dict[str, Path]:
    """Return the checkouts to measure, by the name of the version."""
    earlier = {} if before is None else {"before": before.resolve()}
    return earlier | {"now": ROOT}


def measured(experiment: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an experiment measures in a process of its own.

    Args:
        experiment: The name of its module. It is given the settings as JSON, and prints
            what it has measured as JSON in its last line.
        settings: What it needs to know. ``root`` is the checkout that it imports.
    """
    name = f"benchmarks.experiments.{experiment}"
    done = subprocess.run(
        [sys.executable, "-m", name, json.dumps(settings, default=str)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def show(rows: Iterable[Row]) -> None:
    """Print rows as a table in Markdown, each when it is there."""
    for number, row in enumerate(rows):
        if number == 0:
            print(f"| {' | '.join(row)} |\n{'|---' * len(row)}|")
        print(f"| {' | '.join(map(str, row.values()))} |", flush=True)
