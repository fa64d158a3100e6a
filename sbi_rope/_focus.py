"""Whether an NPE fits simulations from the prior, or one observation only."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope._sbi import ConditionalDensityEstimator, VectorFieldDensity
from sbi_rope.errors import warn_user

__all__ = ["warn_if_focused"]

# How many simulations are looked at, and the fewest that say anything.
NUM_SIMULATIONS, FEWEST = 500, 50
# A density is low if it is below that of the prior by this factor. There is a warning
# if more than this share of the simulations have such a low density.
FACTOR, LARGEST_SHARE = 20.0, 0.1


@torch.no_grad()
def warn_if_focused(
    density: ConditionalDensityEstimator, prior: Any, theta: Tensor, embedded: Tensor
) -> None:
    r"""Warn if an NPE does not fit simulations at draws of the prior.

    The posterior of such simulations obeys

    .. math::
        \Pr\bigl[q(\theta \mid x) < p(\theta) / c\bigr] \le 1 / c,

    because the mean of :math:`p(\theta) / q(\theta \mid x)` over them is at most one.
    An NPE that was trained over several rounds breaks this rule: around other
    observations than the one it was trained for, its density is much too low. sbi keeps
    no trace of rounds in a posterior, so that this is the only sign of them. There may
    be none if the rounds before the last were trained on as well, as in TSNPE.

    Args:
        density: :math:`q(\theta \mid s)`. One without ``log_prob`` is not looked at.
        prior: The prior.
        theta: Draws of the prior, shape ``(n, d)``.
        embedded: The embedding of one simulation of each, shape ``(n, l)``.
    """
    if len(theta) < FEWEST or isinstance(density, VectorFieldDensity):
        return
    theta, embedded = theta[:NUM_SIMULATIONS], embedded[:NUM_SIMULATIONS]
    log_ratio = density.log_prob(theta[None], embedded)[0] - prior.log_prob(theta)
    share = float((log_ratio < -torch.tensor(FACTOR).log()).float().mean())
    if share > LARGEST_SHARE:
        warn_user(
            f"The posterior of NPE does not fit its simulations: in {share:.0%} of "
            f"{len(theta)} of them, the density of their own parameters is more than "
            f"{FACTOR:g} times below that of the prior, where at most "
            f"{1 / FACTOR:.0%} is possible. It may have been trained over several "
            "rounds, which fits the neighbourhood of one observation only, or too "
            "briefly, or with another simulator, other units, or parameters in another "
            "order. Train NPE on this simulator in one round, at draws of the prior."
        )
