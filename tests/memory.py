"""Peak memory, measured in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

__all__ = ["peak_memory", "run_alone"]

STATUS = Path("/proc/self/status")


def peak_memory() -> float:
    """Return the most memory this process has held so far, in MB.

    Not by ``resource``, whose maximum starts at that of the parent process.
    """
    line = next(x for x in STATUS.read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def run_alone(script: str, *arguments: str) -> str:
    """Run a script in a new process; return what it prints."""
    if not STATUS.exists():
        pytest.skip("peak memory is read from /proc")
    run = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[1],
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout
