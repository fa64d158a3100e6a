"""The ways to solve a coupling that have to agree."""

from typing import Any

import pytest
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling

__all__ = ["MODES", "coupled", "raw_coupler"]

MODES = ("own", "blocked", "pot")


def raw_coupler(**settings: Any) -> SinkhornCoupler:
    """A coupler of distances as they are, with the paper's gamma unless it is given."""
    return SinkhornCoupler(**{"gamma": 0.5, "cost_scale": "none", **settings})


def coupled(mode: str, real: Tensor, simulated: Tensor, **settings: Any) -> Coupling:
    """Couple in one of the modes."""
    solver = "pot" if mode == "pot" else "own"
    with pytest.MonkeyPatch.context() as patch:
        if mode == "blocked":
            patch.setattr("sbi_rope.coupling.coupler.MAX_STORED", 0)
        return raw_coupler(solver=solver, **settings).couple(real, simulated)
