"""The ways to solve a coupling that have to agree."""

from typing import Any

import pytest
import torch

from sbi_rope import SinkhornCoupler

__all__ = ["MODES", "digits", "raw_coupler"]

# Settings of SinkhornCoupler.
MODES = [
    pytest.param(
        {"solver": solver, "dtype": dtype, "blocked": blocked},
        id=f"{solver}-{str(dtype).removeprefix('torch.')}{'-blocked' * blocked}",
    )
    for solver, blocked in [("own", False), ("own", True), ("pot", False)]
    for dtype in (torch.float64, torch.float32)
]


def digits(mode: dict[str, Any], *, double: float, single: float) -> float:
    """Return the tolerance for the dtype of a mode."""
    return double if mode["dtype"] == torch.float64 else single


def raw_coupler(**settings: Any) -> SinkhornCoupler:
    """A coupler of distances as they are, with the paper's gamma unless it is given."""
    return SinkhornCoupler(**{"gamma": 0.5, "cost_scale": "none", **settings})
