"""Mixtures of weighted densities, such as the posterior of RoPE."""

from sbi_rope.mixture.average import average
from sbi_rope.mixture.coupled import CoupledEmbeddings
from sbi_rope.mixture.estimator import MixtureEstimator
from sbi_rope.mixture.parts import (
    Mixing,
    OwnEmbeddings,
    Part,
    Rows,
    equal_rows,
    part_of,
)
from sbi_rope.mixture.posterior import MixturePosterior
from sbi_rope.mixture.prior import part_of_prior
from sbi_rope.mixture.prior_posterior import PriorPosterior
from sbi_rope.mixture.truncation import Leakage

__all__ = [
    "CoupledEmbeddings",
    "Leakage",
    "Mixing",
    "MixtureEstimator",
    "MixturePosterior",
    "OwnEmbeddings",
    "Part",
    "PriorPosterior",
    "Rows",
    "average",
    "equal_rows",
    "part_of",
    "part_of_prior",
]
