"""How a stack was made: its seed, how long it took, and with which versions."""

import platform
import time
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import import_module

__all__ = ["Provenance", "Stopwatch"]

# Modules, which all know their version, and the names of their packages.
PACKAGES = {
    "sbi_rope": "sbi-rope",
    "sbi": "sbi",
    "torch": "torch",
    "numpy": "numpy",
    "scipy": "scipy",
    "ot": "POT",
}


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """How a result was made.

    Attributes:
        seed: The seed that was given; None if the states of torch, NumPy and Python
            were used.
        seconds: How long it took.
        finished: When it was finished, in UTC, such as "2026-01-31 12:00 UTC".
        versions: The versions of Python and of packages, by name.
    """

    seed: int | None
    seconds: float
    finished: str
    versions: dict[str, str]


class Stopwatch:
    """Measures how long a result takes, from when it is made."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def provenance(self, seed: int | None) -> Provenance:
        """Return how a result was made that is finished now.

        Args:
            seed: The seed that the user gave.
        """
        return Provenance(
            seed=None if seed is None else int(seed),
            seconds=time.perf_counter() - self._start,
            finished=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
            versions={
                "Python": platform.python_version(),
                **{
                    package: import_module(module).__version__
                    for module, package in PACKAGES.items()
                },
            },
        )
