"""Why something is no posterior that can be repaired, and what to pass instead."""

from typing import Any

import torch
from sbi.inference import (
    EnsemblePosterior,
    ImportanceSamplingPosterior,
    MCMCPosterior,
    RejectionPosterior,
    VIPosterior,
)
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from sbi.inference.posteriors.npe_a_posterior import NPE_A_Posterior
from sbi.inference.potentials.posterior_based_potential import PosteriorBasedPotential
from sbi.inference.trainers.nle.nle_base import LikelihoodEstimatorTrainer
from sbi.inference.trainers.nre.nre_base import RatioEstimatorTrainer
from sbi.neural_nets.estimators.base import ConditionalEstimator
from sbi.utils import RestrictedPrior
from sbi.utils.sbiutils import ImproperEmpirical
from torch import nn

from sbi_rope._sbi.densities import MixtureDensity
from sbi_rope.errors import UnsupportedPosteriorError

__all__ = ["check_prior_of", "check_weights_of", "refuse"]

TRAIN_NPE = "Train NPE on the same simulations and pass its posterior."
SAMPLERS = (
    MCMCPosterior,
    VIPosterior,
    RejectionPosterior,
    ImportanceSamplingPosterior,
)


def refuse(posterior: Any) -> UnsupportedPosteriorError:
    """Return the error for what is not a plain posterior of NPE, FMPE or NPSE."""
    name = type(posterior).__name__
    return UnsupportedPosteriorError(
        "Expected `posterior` to be what `NPE(...).build_posterior()` returns, or the "
        f"posterior of MNPE, FMPE or NPSE; got {name}. {_advice(posterior)}"
    )


def check_prior_of(posterior: Any) -> None:
    """Raise if the prior is unknown, or truncated around one observation as in TSNPE.

    NPE that was made without a prior has one that can neither be sampled nor evaluated.
    sbi makes a truncated one from a posterior by ``get_density_thresholder``. One that
    leaves out parameters whose simulations fail, by a classifier, is no hindrance.
    """
    prior = getattr(posterior, "prior", None)
    if isinstance(prior, ImproperEmpirical):
        raise UnsupportedPosteriorError(
            "Expected a posterior that knows its prior; got one of an NPE without a "
            "prior. Name the one that the simulations' parameters were drawn from: "
            "`npe.build_posterior(prior=prior)`."
        )
    accepts = getattr(prior, "_accept_reject_fn", None)
    made_by = getattr(accepts, "__qualname__", "").split(".")[0]
    if isinstance(prior, RestrictedPrior) and made_by == "get_density_thresholder":
        raise UnsupportedPosteriorError(
            "Expected a posterior that was trained on draws from the whole prior; got "
            "one whose prior is restricted to the neighbourhood of one observation, as "
            "in truncated sequential NPE (TSNPE). Train NPE in one round, on "
            "simulations from the prior, and pass its posterior."
        )


def check_weights_of(estimator: nn.Module) -> None:
    """Raise if a weight of the networks is NaN or Inf, as after a failed training."""
    for name, weights in estimator.named_parameters():
        if not torch.isfinite(weights).all():
            raise UnsupportedPosteriorError(
                "Expected a posterior whose networks have finite weights; its "
                f"estimator has NaN or Inf in `{name}`, so that its training has "
                "failed. Train NPE again, with a lower learning rate or without the "
                "simulations that are far from all others."
            )


def _advice(posterior: Any) -> str:
    if isinstance(posterior, LikelihoodEstimatorTrainer | RatioEstimatorTrainer):
        return (
            "It learns a likelihood or a ratio, which has no embedding of x to tune. "
            + TRAIN_NPE
        )
    if hasattr(posterior, "build_posterior"):
        return "It is a trainer: call `.train()`, then pass `.build_posterior()`."
    if isinstance(posterior, ConditionalEstimator):
        return (
            "It is the network that `train()` returns. Call `build_posterior()` of the "
            "trainer and pass what that returns."
        )
    if isinstance(posterior, EnsemblePosterior):
        return (
            "Repair its members one by one, and average what you get: "
            "`sbi_rope.mixture.average([repaired(member) for member in "
            "posterior.posteriors], weights=posterior.weights)`, with `repaired` a "
            "function of yours that returns `stack(RoPE(member, ...)...)`."
        )
    if isinstance(posterior, NPE_A_Posterior):
        return (
            "It corrects its network for the proposal that it was trained with. "
            + TRAIN_NPE
        )
    if isinstance(posterior, FilteredDirectPosterior):
        return (
            "It compares x with stored simulations and has no embedding of x that was "
            "trained. " + TRAIN_NPE
        )
    if isinstance(posterior, SAMPLERS):
        return _advice_on_sampler(posterior)
    if isinstance(getattr(posterior, "posterior_estimator", None), MixtureDensity):
        return (
            "It mixes such posteriors and has no single embedding of x. What RoPE, a "
            "stack or a baseline has repaired cannot be repaired again: pass the "
            "posterior it was built from."
        )
    return "RoPE needs an amortised posterior whose estimator has an embedding of x."


def _advice_on_sampler(posterior: Any) -> str:
    potential = getattr(posterior, "potential_fn", None)
    if isinstance(potential, PosteriorBasedPotential):
        return (
            "It samples NPE in another way. Call `build_posterior()` without "
            "`sample_with`, and pass what that returns."
        )
    return (
        "It samples what NLE or NRE has learned, a likelihood or a ratio, which has no "
        "embedding of x to tune. " + TRAIN_NPE
    )
