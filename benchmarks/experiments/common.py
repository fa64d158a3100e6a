"""What the experiments share: options, data, and how a table is printed."""

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.machine import describe_machine

# Nothing of the package is imported here: `mixture.py` chooses later which version of
# it is measured.

__all__ = ["Options", "Row", "add_task", "begin", "show"]

# Options of the command line, with what argparse is to know of them.
Options = dict[str, Mapping[str, Any]]
Row = Mapping[str, object]


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


def add_task(options: Options, **task: Any) -> Options:
    """Return the options of an experiment on a task, with those that they share."""
    return {
        "--task": {"required": True, **task},
        "--variant": {"default": ""},
        "--root": {"type": Path, "help": "folder of recorded data"},
        "--hemodynamics": {"type": Path, "help": "folder of stored people"},
        "--preset": {"default": "standard", "help": "settings, see presets.py"},
        "--out": {"type": Path, "default": Path("results/experiments")},
        **options,
    }


def show(rows: Iterable[Row]) -> None:
    """Print rows as a table in Markdown, each when it is there."""
    for number, row in enumerate(rows):
        if number == 0:
            print(f"| {' | '.join(row)} |\n{'|---' * len(row)}|")
        print(f"| {' | '.join(map(str, row.values()))} |", flush=True)
