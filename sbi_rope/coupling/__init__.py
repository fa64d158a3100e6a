"""The coupling of real observations with simulations, by optimal transport.

A user calls ``coupler``, which has the settings, and gets a ``result``. In between,
``cost`` has the distances (stored or computed in blocks), and ``kernel`` computes the
column marginal of a potential. ``fixed_point`` is our own solver, and ``pot`` is POT's.
"""

from sbi_rope.coupling.coupler import SinkhornCoupler
from sbi_rope.coupling.result import Coupling

__all__ = ["Coupling", "SinkhornCoupler"]
