"""What a timing was measured on."""

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["describe_machine", "peak_memory"]

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


def peak_memory() -> float:
    """Return the most memory this process has held so far, in MB (Linux only).

    Not by ``resource``, whose maximum starts at that of the parent process.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    line = next(line for line in lines if line.startswith("VmHWM"))
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
