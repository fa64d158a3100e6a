"""The coupling of real observations with simulations, by optimal transport."""

from sbi_rope.coupling.coupling import Coupling, SinkhornCoupler

__all__ = ["Coupling", "SinkhornCoupler"]
