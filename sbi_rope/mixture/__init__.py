"""The posterior of RoPE: a mixture of simulated posteriors."""

from sbi_rope.mixture.estimator import MixtureEstimator
from sbi_rope.mixture.posterior import MixturePosterior
from sbi_rope.mixture.truncation import Leakage

__all__ = ["Leakage", "MixtureEstimator", "MixturePosterior"]
