"""Run a script in a process of its own, so that its memory can be measured."""

import subprocess
import sys
from pathlib import Path

import pytest

__all__ = ["run_alone"]


def run_alone(script: str, *arguments: str) -> str:
    """Run a script in a new process and return what it prints."""
    if not Path("/proc/self/clear_refs").exists():
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
