"""What a timing was measured on."""

import contextlib
import math
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["describe_machine", "forget_peak", "memory", "peak_memory"]

PACKAGES = ("torch", "POT", "sbi", "ott-jax", "jax")


def describe_machine(*, threads: int) -> str:
    """Return one line: processor, cores, threads used, versions of what matters."""
    packages = []
    for name in PACKAGES:
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return (
        f"{_processor()}, {threads} thread(s); Python {platform.python_version()}, "
        + ", ".join(packages)
    )


def memory() -> float:
    """Return the memory this process holds now, in MB (Linux only)."""
    return _status("VmRSS")


def peak_memory() -> float:
    """Return the most memory this process has held, in MB; NaN if not on Linux.

    Not by ``resource``, whose maximum starts at that of the parent process.
    """
    return _status("VmHWM")


def forget_peak() -> None:
    """Let :func:`peak_memory` start anew, where the system allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _status(name: str) -> float:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    line = next(line for line in lines if line.startswith(name))
    return int(line.split()[1]) / 1024


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [
        line.split(":")[1].strip() for line in lines if line.startswith("model name")
    ]
    return f"{len(names)} x {names[0]}" if names else platform.machine()
