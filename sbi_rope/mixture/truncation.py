"""What the support of the prior does to a mixture: rejection and normalisation."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from tqdm.auto import tqdm

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.errors import SamplingError
from sbi_rope.mixture.estimator import MAX_EVALUATIONS, MixtureEstimator

__all__ = ["LEAKAGE_DRAWS", "Leakage", "component_mass", "draw_inside", "is_unbounded"]

# Draws behind each component's mass inside the prior's support.
LEAKAGE_DRAWS = 1024
# Rejection sampling gives an observation up if, after so many proposals, less than this
# share of them lies inside the prior's support.
MIN_PROPOSALS, MIN_ACCEPTANCE = 100_000, 1e-3

Accept = Callable[[Tensor], Tensor]


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
def draw_inside(
    estimator: MixtureEstimator,
    weights: Tensor,
    num_samples: int,
    *,
    accept: Accept | None,
    batch_size: int,
    show_progress_bars: bool,
) -> Tensor:
    """Draw from each row's mixture until enough proposals are accepted.

    Args:
        estimator: The mixture.
        weights: Its rows, shape ``(B, n_s)``.
        num_samples: Draws of each row.
        accept: Tells which proposals to keep; None keeps all.
        batch_size: Most draws the flow makes at a time.
        show_progress_bars: Whether to show the draws accepted so far.

    Returns:
        Shape ``(num_samples * B, d)``, the rows of ``weights`` varying fastest.

    Raises:
        SamplingError: If next to nothing is accepted for some row.
    """
    num_rows = len(weights)
    # One slot for every sample, open until a proposal for it is accepted.
    slots = torch.arange(num_rows, device=weights.device).repeat(num_samples)
    if not len(slots):
        return estimator.contexts.new_empty(0, *estimator.input_shape)
    if accept is None:
        return estimator.draw(slots, weights, batch_size=batch_size)
    theta = estimator.contexts.new_empty(len(slots), *estimator.input_shape)
    still_open = torch.ones(len(slots), dtype=torch.bool, device=slots.device)
    proposed = torch.zeros(num_rows, dtype=torch.long, device=slots.device)
    inside = proposed.clone()
    repeats = 1
    with tqdm(
        total=len(slots), desc="Sampling", disable=not show_progress_bars
    ) as progress:
        while (open_slots := still_open.nonzero().flatten()).numel():
            proposals = open_slots.repeat_interleave(repeats)
            rows = slots[proposals]
            draws = estimator.draw(rows, weights, batch_size=batch_size)
            accepted = accept(draws)
            # Of several proposals for a slot the first accepted one is kept.
            chosen = accepted.nonzero().flatten()
            filled = proposals[chosen]
            first = filled != filled.roll(1)
            first[:1] = True
            theta[filled[first]] = draws[chosen[first]]
            still_open[filled] = False
            progress.n = len(slots) - int(still_open.sum())
            progress.refresh()
            proposed += rows.bincount(minlength=num_rows)
            inside += rows[accepted].bincount(minlength=num_rows)
            _check_acceptance(proposed, inside)
            # As many proposals as will fill most of the open slots.
            rate = max(float(accepted.double().mean()), MIN_ACCEPTANCE)
            room = MAX_EVALUATIONS // len(open_slots)
            repeats = max(1, min(int(1 / rate), room))
    return theta


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
    mass = []
    with seeded(0):
        chunks = contexts.split(max(1, MAX_EVALUATIONS // LEAKAGE_DRAWS))
        # Some flows need minutes here, and log_prob has no switch for a bar.
        for part in tqdm(chunks, desc="Normalising", delay=5.0, leave=False):
            theta = components.sample(torch.Size((LEAKAGE_DRAWS,)), condition=part)
            inside = accept(theta.reshape(-1, *components.input_shape))
            mass.append(inside.reshape(LEAKAGE_DRAWS, -1).double().mean(dim=0))
    return torch.cat(mass)


def is_unbounded(prior: Distribution) -> bool:
    """Tell whether a prior says that its support is the whole space."""
    try:
        support: Any = getattr(prior, "support", None)
    except NotImplementedError:  # torch's way of saying that a law states none
        return False
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    return support in (constraints.real, constraints.real_vector)


def _check_acceptance(proposed: Tensor, inside: Tensor) -> None:
    hopeless = (proposed >= MIN_PROPOSALS) & (inside < MIN_ACCEPTANCE * proposed)
    if hopeless.any():
        rows = hopeless.nonzero().flatten()[:5].tolist()
        raise SamplingError(
            f"Less than one in {int(1 / MIN_ACCEPTANCE)} draws lies inside the support "
            f"of the prior for the observations in rows {rows} of `x`: the posteriors "
            "of the simulations leak. Train NPE longer, or with "
            "z_score_theta='transform_to_unconstrained', or pass "
            "reject_outside_prior=False."
        )
