"""Where this package touches the inside of sbi, and nowhere else."""

from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sbi.inference.posteriors.vector_field_posterior import VectorFieldPosterior
from sbi.inference.potentials.base_potential import BasePotential
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    UnconditionalDensityEstimator,
)
from sbi.neural_nets.net_builders.flow import build_zuko_unconditional_flow
from sbi.samplers.mcmc import SliceSamplerVectorized
from sbi.utils.user_input_checks_utils import move_distribution_to_device

from sbi_rope._sbi.densities import (
    MixedDensity,
    VectorFieldDensity,
    gaussians_of,
)
from sbi_rope._sbi.embedding import (
    device_of,
    dtype_of,
    embed,
    embedding_of,
    headless,
    standardisation_of,
    with_embedding,
)
from sbi_rope._sbi.mmd import squared_mmd
from sbi_rope._sbi.posteriors import (
    BaseDirectPosterior,
    check_density,
    describe,
    direct_posterior,
    estimator_of,
    is_bounded,
    posterior_from,
)
from sbi_rope._sbi.reading import check_rows_apart, readable
from sbi_rope._sbi.trainer import train_npe

__all__ = [
    "BaseDirectPosterior",
    "BasePotential",
    "ConditionalDensityEstimator",
    "ConditionalEstimator",
    "DirectPosterior",
    "MixedDensity",
    "NeuralPosterior",
    "SliceSamplerVectorized",
    "UnconditionalDensityEstimator",
    "VectorFieldDensity",
    "VectorFieldPosterior",
    "build_zuko_unconditional_flow",
    "check_density",
    "check_rows_apart",
    "describe",
    "device_of",
    "direct_posterior",
    "dtype_of",
    "embed",
    "embedding_of",
    "estimator_of",
    "gaussians_of",
    "headless",
    "is_bounded",
    "move_distribution_to_device",
    "posterior_from",
    "readable",
    "squared_mmd",
    "standardisation_of",
    "train_npe",
    "with_embedding",
]
