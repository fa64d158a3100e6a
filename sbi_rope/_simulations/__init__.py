"""Sources of simulations: what RoPE needs of them, and a stored set of pairs.

:mod:`sbi_rope._simulator` is the other source, a user's simulator.
"""

from sbi_rope._simulations.moments import Moments
from sbi_rope._simulations.source import (
    Embedding,
    Readable,
    SimulationSource,
    all_finite,
)
from sbi_rope._simulations.stored import StoredSimulations
from sbi_rope._simulations.targets import check_targets, draw_targets

__all__ = [
    "Embedding",
    "Moments",
    "Readable",
    "SimulationSource",
    "StoredSimulations",
    "all_finite",
    "check_targets",
    "draw_targets",
]
