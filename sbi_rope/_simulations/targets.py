"""The targets of the tuning: mean embeddings of simulations at the labels."""

import torch
from torch import Tensor

from sbi_rope._simulations.source import Embedding, SimulationSource
from sbi_rope.errors import SimulationError, in_digits

__all__ = ["check_targets", "draw_targets"]


def draw_targets(
    source: SimulationSource,
    theta: Tensor,
    embed: Embedding,
    *,
    simulations_per_target: int,
    num_neighbors: int,
    progress: bool,
) -> Tensor:
    r"""Return the targets of the tuning, :math:`E_\varepsilon[h(S(\theta_i))]`.

    Args:
        source: The source of simulations.
        theta: Parameters of the pairs, shape ``(n, d)``.
        embed: The embedding h.
        simulations_per_target: The number of simulations that a simulator makes for
            each target.
        num_neighbors: The number of stored simulations for each target.
        progress: Whether to show the progress of slow simulations.

    Returns:
        Shape ``(n, l)``.

    Raises:
        SimulationError: If the simulator fails, or an embedding is not finite.
    """
    targets = source.targets(
        theta,
        embed,
        simulations_per_target=simulations_per_target,
        num_neighbors=num_neighbors,
        progress=progress,
    )
    return check_targets(targets, theta)


def check_targets(targets: Tensor, theta: Tensor) -> Tensor:
    """Return the targets of the tuning if they are finite.

    Raises:
        SimulationError: If they are not.
    """
    usable = torch.isfinite(torch.linalg.vector_norm(targets, dim=1))
    if not usable.all():
        raise SimulationError(
            "Expected simulations with a finite embedding; got NaN, Inf or numbers "
            f"too large to compare at the calibration parameters "
            f"{in_digits(theta[~usable])}. Check what the simulator returns there, "
            "or remove these pairs."
        )
    return targets
