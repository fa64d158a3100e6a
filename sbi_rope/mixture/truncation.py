"""How much of a mixture lies inside the support of the prior."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from tqdm.auto import tqdm

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.mixture.chunks import flow_batch, keep_freed_memory
from sbi_rope.mixture.sampling import Accept

__all__ = ["LEAKAGE_DRAWS", "Leakage", "component_mass", "is_unbounded", "mixture_mass"]

# Draws behind each component's mass inside the prior's support.
LEAKAGE_DRAWS = 1024


@dataclass(frozen=True)
class Leakage:
    r"""The mass of each observation's mixture inside the prior's support.

    Attributes:
        mass: :math:`Z_i = \sum_j \alpha_{ij} Z_j`, shape ``(n,)``.
        standard_error: Of ``mass``, from the draws behind each :math:`Z_j`.
    """

    mass: Tensor
    standard_error: Tensor


@torch.no_grad()
def component_mass(
    components: ConditionalDensityEstimator,
    contexts: Tensor,
    *,
    accept: Accept | None,
) -> Tensor:
    """Estimate each component's mass inside the support, shape ``(n_s,)``, float64.

    The draws have random numbers of their own. Without a bound (None) it is one.
    """
    if accept is None:
        return torch.ones(len(contexts), dtype=torch.double, device=contexts.device)
    keep_freed_memory(contexts.device)
    mass = []
    with seeded(0):
        chunks = contexts.split(max(1, flow_batch(contexts.device) // LEAKAGE_DRAWS))
        # Some flows need minutes here, and log_prob has no switch for a bar.
        for part in tqdm(chunks, desc="Normalising", delay=5.0, leave=False):
            theta = components.sample(torch.Size((LEAKAGE_DRAWS,)), condition=part)
            inside = accept(theta.reshape(-1, *components.input_shape))
            mass.append(inside.reshape(LEAKAGE_DRAWS, -1).double().mean(dim=0))
    return torch.cat(mass)


def mixture_mass(
    mass: Tensor, row_blocks: Iterable[Tensor], *, exact: bool = False
) -> Leakage:
    """Return the mass of mixtures, given that of their components.

    Args:
        mass: Of each component, shape ``(n_s,)``.
        row_blocks: The mixture weights, shapes ``(b, n_s)``.
        exact: Whether the masses are known, not estimated.
    """
    # Without the half a draw, components with no or all draws inside had no error.
    smoothed = (LEAKAGE_DRAWS * mass + 0.5) / (LEAKAGE_DRAWS + 1)
    variance = smoothed * (1.0 - smoothed) / LEAKAGE_DRAWS * (0.0 if exact else 1.0)
    means, errors = [], []
    for rows in row_blocks:
        weights = rows.to(mass)
        means.append(weights @ mass)
        errors.append((weights.square() @ variance).sqrt())
    return Leakage(torch.cat(means), torch.cat(errors))


def is_unbounded(prior: Distribution) -> bool:
    """Tell whether a prior says that its support is the whole space."""
    try:
        support: Any = getattr(prior, "support", None)
    except NotImplementedError:  # torch's way of saying that a law states none
        return False
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    return support in (constraints.real, constraints.real_vector)
