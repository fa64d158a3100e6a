"""Densities of parameters given an observation, such as the posterior of RoPE."""

from sbi_rope.density.base import Density, Prior
from sbi_rope.density.coupled import Coupled, OverSimulations
from sbi_rope.density.flow import Flow
from sbi_rope.density.mixture import Mixture, density_of
from sbi_rope.density.posterior import MixturePosterior, PriorPosterior
from sbi_rope.density.regression import GaussianProcess

__all__ = [
    "Coupled",
    "Density",
    "Flow",
    "GaussianProcess",
    "Mixture",
    "MixturePosterior",
    "OverSimulations",
    "Prior",
    "PriorPosterior",
    "density_of",
]
