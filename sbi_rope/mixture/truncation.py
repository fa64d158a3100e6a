"""How much of a mixture lies inside the support of the prior."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from sbi_rope._bounds import support_of
from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.mixture.chunks import blocks, flow_batch, keep_freed_memory
from sbi_rope.mixture.parts import Part
from sbi_rope.mixture.sampling import Accept

__all__ = [
    "LEAKAGE_DRAWS",
    "Leakage",
    "component_mass",
    "is_unbounded",
    "own_mass",
    "shared_mass",
]

# The number of draws from which the mass inside the prior's support is estimated, given
# a shared embedding or for a part with a weight of one.
LEAKAGE_DRAWS = 1024


@dataclass(frozen=True)
class Leakage:
    r"""The mass of each observation's mixture inside the prior's support.

    Attributes:
        mass: :math:`Z_i`, shape ``(n,)``, float64.
        standard_error: The standard error of ``mass``, shape ``(n,)``, float64.
    """

    mass: Tensor
    standard_error: Tensor


@torch.no_grad()
def component_mass(
    density: ConditionalDensityEstimator,
    embeddings: Tensor,
    *,
    accept: Accept,
    show_progress_bars: bool = False,
) -> Tensor:
    """Estimate the mass inside the support given each embedding, ``(c,)``, float64.

    The draws have a seed of their own.
    """
    keep_freed_memory(embeddings.device)
    mass = []
    with seeded(0):
        chunks = embeddings.split(
            max(1, flow_batch(embeddings.device) // LEAKAGE_DRAWS)
        )
        # Some flows take minutes here.
        for some in _bar(chunks, show=show_progress_bars):
            mass.append(_share_inside(density, some, accept, LEAKAGE_DRAWS))
    return torch.cat(mass)


def shared_mass(part: Part, embedded: Tensor, mass: Tensor) -> Leakage:
    """Return the mass of a part whose embeddings are shared by all observations.

    Args:
        part: The part.
        embedded: The result of its ``embed`` for the observations, shape ``(n, ...)``.
        mass: The result of :func:`component_mass` for the embeddings, shape ``(c,)``.
    """
    variance = _variance(mass, LEAKAGE_DRAWS)
    means, errors = [], []
    for block in blocks(len(embedded), part.mixing.num_embeddings):
        weights = part.mixing.rows(embedded[block]).weights.to(mass)
        means.append(weights @ mass)
        errors.append((weights.square() @ variance).sqrt())
    return Leakage(torch.cat(means), torch.cat(errors))


@torch.no_grad()
def own_mass(
    part: Part,
    embedded: Tensor,
    *,
    accept: Accept,
    num_draws: int,
    seed: int,
    show_progress_bars: bool = False,
) -> Leakage:
    """Estimate the mass of a part in which each observation has its own embeddings.

    The random numbers are the same in every call. The random numbers of an observation
    depend on its position among the observations of the call, and so does its mass,
    within the standard error.

    Args:
        part: The part.
        embedded: The result of its ``embed`` for the observations, shape ``(n, ...)``.
        accept: Tells which parameters ``(n, d)`` are inside the support.
        num_draws: Draws for each observation, over all its embeddings together.
        seed: The seed of the draws. It differs between parts: with the same random
            numbers, the errors of similar parts would add up instead of averaging out.
        show_progress_bars: Whether to show progress if the estimate takes long.
    """
    num_embeddings = part.mixing.num_embeddings
    of_each = math.ceil(num_draws / num_embeddings)
    size = max(1, flow_batch(embedded.device) // (of_each * num_embeddings))
    means, errors = [], []
    with seeded(seed):
        for block in _bar(embedded.split(size), show=show_progress_bars):
            rows = part.mixing.rows(block)
            weights, embeddings = rows.weights.double(), rows.embeddings.flatten(0, 1)
            inside = _share_inside(part.density, embeddings, accept, of_each)
            inside = inside.reshape(weights.shape)
            means.append((weights * inside).sum(dim=1))
            variance = weights.square() * _variance(inside, of_each)
            errors.append(variance.sum(dim=1).sqrt())
    return Leakage(torch.cat(means), torch.cat(errors))


def _share_inside(
    density: ConditionalDensityEstimator, embeddings: Tensor, accept: Accept, draws: int
) -> Tensor:
    """Return the share of draws that is accepted, for each embedding ``(c, l)``."""
    theta = density.sample(torch.Size((draws,)), condition=embeddings)
    inside = accept(theta.reshape(-1, *density.input_shape))
    return inside.reshape(draws, -1).double().mean(dim=0)


def _variance(share: Tensor, draws: int) -> Tensor:
    # Half a draw is added to the draws inside and to those outside. Otherwise the mass
    # would seem to have no error if all draws are inside, or all are outside.
    smoothed = (draws * share + 0.5) / (draws + 1)
    return smoothed * (1.0 - smoothed) / draws


def _bar(parts: Iterable[Any], *, show: bool) -> Any:
    return progress_bar(parts, show=show, desc="Normalising", delay=5.0, leave=False)


def is_unbounded(prior: Distribution) -> bool:
    """Tell whether a prior says that its support is the whole space."""
    support = support_of(prior)
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    return support in (constraints.real, constraints.real_vector)
