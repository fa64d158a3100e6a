"""Moments of simulations at parameters that are known from labels."""

import torch
from torch import Tensor

from sbi_rope._labels.parameters import LabelledParameters
from sbi_rope._simulations import (
    Embedding,
    Moments,
    SimulationSource,
    check_targets,
    draw_targets,
)

__all__ = ["labelled_moments", "labelled_targets"]

# A quadratic surface has so many simulations for each of its coefficients, at least.
SIMULATIONS_PER_COEFFICIENT = 3
# Strength of the ridge, relative to the number of simulations.
RIDGE = 1e-4


def labelled_moments(
    source: SimulationSource,
    parameters: LabelledParameters,
    count: int,
    embed: Embedding,
    *,
    progress: bool,
) -> Moments:
    r"""Return the moments of simulations at the parameters of each pair.

    For exact labels, these are the moments of ``count`` simulations at the parameters.
    Otherwise one simulation is made at each draw of the parameters that the label
    leaves possible. A surface :math:`m(\theta)` is fitted to the simulations of each
    label, linear or, if there are enough draws, quadratic. Its values at the draws are
    the possible means of the pair. The covariance of the residuals estimates that of
    simulations at one parameter.

    Args:
        source: Where simulations come from.
        parameters: The draws of the parameters.
        count: The number of simulations at each exact label.
        embed: The representation of simulations whose moments are returned.
        progress: Whether to show the progress of slow simulations.
    """
    theta = parameters.draws
    if parameters.are_exact:
        return source.moments(theta[:, 0], count, embed, progress=progress)
    n, num_draws, d = theta.shape
    simulated = source.draws(theta.reshape(-1, d), 1, embed, progress=progress)
    simulated = simulated.double().reshape(n, num_draws, -1)
    design = _features(theta.double())
    level = simulated.mean(dim=1, keepdim=True)
    penalty = RIDGE * num_draws * torch.eye(design.shape[2]).to(design)
    normal = design.mT @ design + penalty
    coefficients = torch.linalg.solve(normal, design.mT @ (simulated - level))
    fitted = level + design @ coefficients
    residual = simulated - fitted
    # As many parameters as were effectively fitted; for exact labels it is the mean.
    used = torch.linalg.solve(normal, design.mT @ design).diagonal(dim1=1, dim2=2)
    freedom = (num_draws - 1 - used.sum(dim=1)).clamp_min(1.0)
    return Moments(
        mean=fitted.mean(dim=1),
        covariance=residual.mT @ residual / freedom[:, None, None],
        possible=fitted,
    )


def labelled_targets(
    source: SimulationSource,
    parameters: LabelledParameters,
    embed: Embedding,
    *,
    simulations_per_target: int,
    num_neighbors: int,
    progress: bool,
) -> Tensor:
    r"""Return the targets of the tuning, :math:`E[h(S(\theta)) \mid y_i]`.

    For exact labels see :func:`~sbi_rope._simulations.draw_targets`. Otherwise the
    expectation is also over the parameters that the label leaves possible, with one
    simulation at each of at most ``simulations_per_target`` draws.

    Raises:
        SimulationError: If the simulator fails, or an embedding is not finite.
    """
    if parameters.are_exact:
        return draw_targets(
            source,
            parameters.mean,
            embed,
            simulations_per_target=simulations_per_target,
            num_neighbors=num_neighbors,
            progress=progress,
        )
    theta = parameters.draws[:, :simulations_per_target]
    n, count, d = theta.shape
    embedded = source.draws(theta.reshape(-1, d), 1, embed, progress=progress)
    targets = embedded.reshape(n, count, -1).mean(dim=1)
    return check_targets(targets, parameters.mean)


def _features(theta: Tensor) -> Tensor:
    """Return linear and, with enough draws, quadratic terms of standardised draws.

    All terms have mean zero, shape ``(n, R, p)``. Parameters that do not vary, because
    they are known exactly, have terms of zero.
    """
    centred = theta - theta.mean(dim=1, keepdim=True)
    std = centred.square().mean(dim=1, keepdim=True).sqrt()
    scale = theta.abs().amax(dim=1, keepdim=True).clamp_min(1e-30)
    linear = torch.where(std > 1e-6 * scale, centred / std.clamp_min(1e-30), 0.0)
    d = theta.shape[2]
    num_terms = d + d * (d + 1) // 2
    if num_terms * SIMULATIONS_PER_COEFFICIENT > theta.shape[1]:
        return linear
    first, second = torch.triu_indices(d, d).to(theta.device)
    quadratic = linear[..., first] * linear[..., second]
    quadratic = quadratic - quadratic.mean(dim=1, keepdim=True)
    return torch.cat([linear, quadratic], dim=2)
