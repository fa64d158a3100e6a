"""The coupling of real observations with simulations, by optimal transport.

``coupler`` has the settings and is what a user calls. ``result`` is what comes back.
The work is done in between by ``problem`` (two checked sets of embeddings), ``cost``
(their distances, stored or computed in blocks), ``kernel`` (the column marginal of a
potential), ``fixed_point`` (our own solver), ``pot`` (POT's solver) and ``warm_start``
(where the solver starts in a sweep).
"""

from sbi_rope.coupling.coupler import SinkhornCoupler
from sbi_rope.coupling.result import Coupling

__all__ = ["Coupling", "SinkhornCoupler"]
