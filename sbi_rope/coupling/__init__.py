"""The coupling of real observations with simulations, by optimal transport.

``coupler`` is what a user sets and calls, ``result`` what comes back. The work between
them: ``cost`` (distances, stored or computed in blocks), ``kernel`` (the marginal of a
potential), ``fixed_point`` (our own solver) and ``pot`` (POT's).
"""

from sbi_rope.coupling.coupler import SinkhornCoupler
from sbi_rope.coupling.result import Coupling

__all__ = ["Coupling", "SinkhornCoupler"]
