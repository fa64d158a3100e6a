"""Estimators of sbi in the shape of densities that can be mixed."""

import warnings
from typing import Any, Literal

import torch
from sbi.inference.posteriors.vector_field_posterior import VectorFieldPosterior
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalVectorFieldEstimator,
)
from sbi.neural_nets.estimators.mixed_density_estimator import MixedDensityEstimator
from sbi.neural_nets.estimators.mixture_density_estimator import (
    MixtureDensityEstimator,
)
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope.errors import LogProbUnavailableError

__all__ = [
    "MixedDensity",
    "VectorFieldDensity",
    "gaussians_of",
]

# What sbi adds to the precision of each Gaussian that it mixes.
SMALLEST_PRECISION = 1e-4


class MixedDensity(ConditionalDensityEstimator):
    """The mixed estimator of MNPE, as a density over all of the prior's support.

    Where sbi's own has no density it is zero: at a category that was not trained on,
    which sbi gives the mass of the next larger one or refuses, and with
    ``log_transform_x`` at zero and below, where sbi returns NaN.
    """

    def __init__(self, estimator: MixedDensityEstimator) -> None:
        super().__init__(estimator, estimator.input_shape, estimator.condition_shape)
        self.mixed = estimator

    @property
    def embedding_net(self) -> nn.Module:
        """The embedding net of both parts."""
        return self.mixed.condition_embedding

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log of density times mass, ``(S, B)``."""
        categories = self.mixed.discrete_net.net.categorical_values_per_var
        continuous = input[..., : -len(categories)]
        # Detached, so that gradient ascent does not move between categories.
        discrete = input[..., -len(categories) :].detach()
        trained = torch.stack(
            [
                torch.isin(column, values.to(column))
                for column, values in zip(discrete.unbind(-1), categories, strict=True)
            ],
            dim=-1,
        )
        inside = torch.ones_like(continuous, dtype=torch.bool)
        if self.mixed.log_transform_input:
            inside = continuous > 0
        # Anything that can be evaluated stands in for what cannot.
        some = torch.stack([values[0] for values in categories]).to(discrete)
        valid = torch.cat(
            [continuous.where(inside, 1.0), discrete.where(trained, some)], dim=-1
        )
        log_prob = self.mixed.log_prob(valid, condition)
        possible = trained.all(dim=-1) & inside.all(dim=-1)
        return log_prob.where(possible, -torch.inf)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw the discrete parameters, then the continuous ones given these."""
        return self.mixed.sample(sample_shape, condition, **kwargs)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


class VectorFieldDensity(ConditionalDensityEstimator):
    """A vector field (FMPE, NPSE) in the shape of a density that can only be sampled.

    Its density would need one ODE solve per component and parameter, so ``log_prob``
    raises instead of starting hours of work.
    """

    def __init__(
        self,
        estimator: ConditionalVectorFieldEstimator,
        prior: Distribution,
        sample_with: Literal["ode", "sde"],
    ) -> None:
        super().__init__(estimator, estimator.input_shape, estimator.condition_shape)
        self.vector_field = estimator
        self.prior = prior
        self.sample_with: Literal["ode", "sde"] = sample_with

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Solve the ODE or SDE for every condition; no prior support is enforced."""
        with seeded(0):  # sbi draws from the prior to look at it
            posterior = VectorFieldPosterior(
                self.vector_field,
                self.prior,
                device=condition.device,
                sample_with=self.sample_with,
            )
        with warnings.catch_warnings():
            # Draws outside the prior are rejected by the mixture; the batch is ours.
            warnings.filterwarnings("ignore", message=".*outside the prior support")
            warnings.filterwarnings("ignore", message="Capping max_sampling_batch")
            warnings.filterwarnings("ignore", message="Note that for batched sampling")
            return posterior.sample_batched(
                sample_shape,
                condition,
                show_progress_bars=False,
                reject_outside_prior=False,
            )

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Raise: the density of a vector field is not evaluated."""
        raise LogProbUnavailableError(
            "log_prob is not available for posteriors of FMPE and NPSE: every mixture "
            "component would need its own ODE solve. Use samples, or train NPE."
        )

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the loss of the vector field."""
        return self.vector_field.loss(input, condition, **kwargs)


def gaussians_of(
    estimator: MixtureDensityEstimator, condition: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians that a mixture density network mixes.

    Args:
        estimator: The network, which was built with ``z_score_x="none"``, so that the
            Gaussians have the units of what it is a density of.
        condition: Conditions, shape ``(n, k)``.

    Returns:
        The logarithms of their weights up to a constant, shape ``(n, c)``, their means,
        ``(n, c, l)``, and covariances, ``(n, c, l, l)``, all in float64.
    """
    mixture = estimator.get_uncorrected_mog(condition)
    assert not estimator.has_input_transform
    factors = mixture.precision_factors
    assert factors is not None
    # In float32 a narrow covariance would not be positive definite after rounding.
    factors = factors.double()
    identity = torch.eye(factors.shape[-1]).to(factors)
    precision = factors.mT @ factors + SMALLEST_PRECISION * identity
    covariances = torch.cholesky_inverse(torch.linalg.cholesky(precision))
    return mixture.logits.double(), mixture.means.double(), covariances
