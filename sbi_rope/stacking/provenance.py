"""How a stack was made: its seed, what it took, and with which versions."""

import platform
import time
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import import_module

from sbi_rope.rope import RoPE

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
        num_simulator_calls: How many simulations the simulator made for it; 0 if all
            were there already.
        finished: When it was finished, in UTC, such as "2026-01-31 12:00 UTC".
        versions: The versions of Python and of packages, by name.
    """

    seed: int | None
    seconds: float
    num_simulator_calls: int
    finished: str
    versions: dict[str, str]


class Stopwatch:
    """Measures what a result takes of a RoPE, from when the watch is made."""

    def __init__(self, rope: RoPE) -> None:
        self._rope = rope
        self._calls = rope.num_simulator_calls
        self._start = time.perf_counter()

    def provenance(self, seed: int | None) -> Provenance:
        """Return how a result was made that is finished now.

        Args:
            seed: The seed that the user gave.
        """
        return Provenance(
            seed=None if seed is None else int(seed),
            seconds=time.perf_counter() - self._start,
            num_simulator_calls=self._rope.num_simulator_calls - self._calls,
            finished=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
            versions={
                "Python": platform.python_version(),
                **{
                    package: import_module(module).__version__
                    for module, package in PACKAGES.items()
                },
            },
        )
