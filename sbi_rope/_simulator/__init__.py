"""A user's simulator: how to call it is found out before it is used.

``probe`` finds out how, ``calls`` calls it, ``workers`` calls it in several processes,
and ``source`` makes it a source of simulations.
"""

from sbi_rope._simulator.budget import LimitedSimulator
from sbi_rope._simulator.calls import check_callable
from sbi_rope._simulator.source import Simulator, source_of
from sbi_rope._simulator.workers import parallel

__all__ = [
    "LimitedSimulator",
    "Simulator",
    "check_callable",
    "parallel",
    "source_of",
]
