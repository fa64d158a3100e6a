"""Trained estimators as tensors: what can be kept in a file that runs no code."""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import torch
from sbi.inference.posteriors import DirectPosterior
from torch import Tensor

# Nothing of this package: `mixture.py` chooses later which version of it is measured.

__all__ = ["posterior_with", "state_of"]


def state_of(posterior: Any) -> dict[str, Tensor]:
    """Return the weights and buffers of the estimator in a posterior of NPE."""
    state = posterior.posterior_estimator.state_dict()
    return {name: values.detach().cpu().clone() for name, values in state.items()}


def posterior_with(
    state: Mapping[str, Tensor],
    *,
    prior: Any,
    build: Callable[[Tensor, Tensor], Any],
    simulations: tuple[Tensor, Tensor],
    device: str = "cpu",
) -> DirectPosterior:
    """Build a posterior of NPE anew, and give it the weights of a trained one.

    Args:
        state: What :func:`state_of` returned.
        prior: The prior.
        build: What sbi's ``posterior_nn(...)`` returns.
        simulations: Pairs of the shapes that it was trained on.
        device: Where to put it.

    Raises:
        RuntimeError: If the weights are those of another estimator.
    """
    # Its first weights are random, and none of them is kept.
    with torch.random.fork_rng():
        # `build` may put its own embedding net into each estimator that it builds.
        estimator = copy.deepcopy(build(*simulations))
    estimator.load_state_dict(state)
    estimator = estimator.to(device).eval()
    prior = copy.deepcopy(prior)
    if hasattr(prior, "to"):
        prior.to(device)
    return DirectPosterior(estimator, prior, device=device)
