"""Densities of parameters given an observation, such as the posterior of RoPE."""

from sbi_rope.density.base import Density, Mass
from sbi_rope.density.coupled import Coupled, OverSimulations
from sbi_rope.density.flow import Flow
from sbi_rope.density.given import Given, density_of
from sbi_rope.density.mixture import Mixture, average
from sbi_rope.density.posterior import MixturePosterior
from sbi_rope.density.prior import Prior, PriorPosterior

__all__ = [
    "Coupled",
    "Density",
    "Flow",
    "Given",
    "Mass",
    "Mixture",
    "MixturePosterior",
    "OverSimulations",
    "Prior",
    "PriorPosterior",
    "average",
    "density_of",
]
