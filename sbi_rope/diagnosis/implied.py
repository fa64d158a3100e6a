"""The parameters that embeddings imply: those of the simulations near them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.diagnosis.simulations import Simulations

__all__ = ["Implied", "couple_by_itself", "implied_by", "resampled"]

# At tau = 0 each observation is coupled by itself, without trust in the prior. The
# smaller gamma is, the less the implied distribution is blurred.
COUPLER = SinkhornCoupler(gamma=0.1, tau=0.0, cost_scale="simulated")
# Points at which distribution functions are compared.
NUM_POINTS = 100
CHUNK = 500


@dataclass(frozen=True, eq=False, kw_only=True)
class Implied:
    """The parameters that the observations of a set imply.

    Attributes:
        weights: Mean weights of the simulations, which sum to one, ``(n_s,)``.
        functions: The distribution functions of each observation, at points of each
            parameter, ``(n, d, points)``.
        means: The mean parameters of each observation, ``(n, d)``.
    """

    weights: Tensor
    functions: Tensor
    means: Tensor


def couple_by_itself(simulations: Simulations) -> Coupling:
    """Return a coupling whose rows depend on one observation only."""
    # At tau = 0 the potential is zero for any batch, so that a few rows are enough.
    return COUPLER.couple(simulations.embedded[:100], simulations.embedded)


def implied_by(
    coupling: Coupling,
    real: Tensor,
    simulations: Simulations,
    *,
    own: Tensor | None = None,
) -> Implied:
    r"""Return the parameters that embeddings imply.

    Observation i gives simulation j the weight
    :math:`\operatorname{softmax}_j(-C_{ij} / \gamma)`.

    Args:
        coupling: What :func:`couple_by_itself` returns.
        real: Embeddings, shape ``(n, l)``.
        simulations: The simulations.
        own: For simulations that take the place of observations, their numbers. None
            is matched with itself.
    """
    theta = simulations.theta
    order, where = _points(theta)
    total = torch.zeros(len(theta), dtype=torch.float64)
    functions, means = [], []
    for first in range(0, len(real), CHUNK):
        block = slice(first, first + CHUNK)
        weights = coupling.rows(real[block])
        if own is not None:
            rows = torch.arange(len(weights))
            weights[rows, own[block]] = 0.0
            weights = weights / weights.sum(dim=1, keepdim=True).clamp_min(1e-300)
        total += weights.sum(dim=0)
        means.append(weights @ theta)
        functions.append(
            torch.stack(
                [weights[:, column].cumsum(dim=1)[:, where] for column in order.T],
                dim=1,
            )
        )
    return Implied(
        weights=total / len(real),
        functions=torch.cat(functions),
        means=torch.cat(means),
    )


def _points(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return the order of each parameter, and the ranks at which to compare."""
    last = len(theta) - 1
    where = torch.linspace(0, last, min(NUM_POINTS, len(theta))).round().long()
    return theta.argsort(dim=0), where


def resampled(values: Tensor, size: int, *, num_draws: int) -> Tensor:
    """Return means over rows drawn with replacement, ``(num_draws, ...)``.

    Args:
        values: Shape ``(n, ...)``.
        size: The number of rows in each draw.
        num_draws: The number of draws.
    """
    count = len(values)
    rows = torch.randint(count, (num_draws, size))
    rows += count * torch.arange(num_draws).unsqueeze(1)
    times = torch.bincount(rows.flatten(), minlength=num_draws * count)
    draws = times.reshape(num_draws, count).to(values)
    mean = draws @ values.reshape(count, -1) / size
    return mean.reshape(num_draws, *values.shape[1:])
