"""Moments of simulations at parameters that are known from labels."""

import torch
from torch import Tensor

from sbi_rope._labels.parameters import LabelledParameters
from sbi_rope.simulate import Embedding, Moments, SimulationSource

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

    A surface also fits the noise of the simulations. Its linear and its quadratic terms
    are shrunk by how much of their size is noise, as James and Stein did, so that
    labels that are nearly exact have a single possible mean.

    References:
        | Estimation with Quadratic Loss (James and Stein, 1961)
        | https://projecteuclid.org/euclid.bsmsp/1200512173

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
    n, num_draws, _ = theta.shape
    theta, simulated = source.once_at(theta, embed, progress=progress)
    simulated = simulated.double()
    level = simulated.mean(dim=1, keepdim=True)
    residual = simulated - level
    freedom = simulated.new_full((n,), num_draws - 1)
    fits = []
    for terms in _features(theta.double()):
        fitted, used = _regressed(residual, terms)
        residual = residual - fitted
        freedom = freedom - used
        fits.append((fitted, used))
    covariance = residual.mT @ residual / freedom.clamp_min(1.0)[:, None, None]
    noise = covariance.mean(dim=0).diagonal()
    surface = sum(_shrunk(fitted, used[:, None] * noise) for fitted, used in fits)
    return Moments(mean=level[:, 0], covariance=covariance, possible=level + surface)


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

    Where labels are not exact, the expectation is also over the parameters that they
    leave possible, with ``simulations_per_target`` simulations at draws of these.

    Raises:
        SimulationError: If the simulator fails.
    """
    if parameters.are_exact:
        return source.targets(
            parameters.mean,
            embed,
            simulations_per_target=simulations_per_target,
            num_neighbors=num_neighbors,
            progress=progress,
        )
    num_draws = parameters.draws.shape[1]
    theta = parameters.draws[:, torch.arange(simulations_per_target) % num_draws]
    _, embedded = source.once_at(theta, embed, progress=progress)
    return embedded.mean(dim=1)


def _features(theta: Tensor) -> list[Tensor]:
    """Return linear and, with enough draws, quadratic terms of standardised draws.

    All terms have mean zero, shape ``(n, R, p)``, and quadratic ones have no linear
    part. Parameters that do not vary, because they are known exactly, have terms of
    zero.
    """
    centred = theta - theta.mean(dim=1, keepdim=True)
    std = centred.square().mean(dim=1, keepdim=True).sqrt()
    scale = theta.abs().amax(dim=1, keepdim=True).clamp_min(1e-30)
    linear = torch.where(std > 1e-6 * scale, centred / std.clamp_min(1e-30), 0.0)
    d = theta.shape[2]
    num_terms = d + d * (d + 1) // 2
    if num_terms * SIMULATIONS_PER_COEFFICIENT > theta.shape[1]:
        return [linear]
    first, second = torch.triu_indices(d, d).to(theta.device)
    quadratic = linear[..., first] * linear[..., second]
    quadratic = quadratic - quadratic.mean(dim=1, keepdim=True)
    return [linear, quadratic - _regressed(quadratic, linear)[0]]


def _regressed(y: Tensor, terms: Tensor) -> tuple[Tensor, Tensor]:
    """Return the part of y that is linear in some terms, and how many were fitted.

    Args:
        y: Shape ``(n, R, l)``.
        terms: Shape ``(n, R, p)``.

    Returns:
        The fit, of the shape of y, and the effective number of terms, ``(n,)``.
    """
    ridge = RIDGE * terms.shape[1] * torch.eye(terms.shape[2]).to(terms)
    normal = terms.mT @ terms
    used = torch.linalg.solve(normal + ridge, normal).diagonal(dim1=1, dim2=2)
    return terms @ torch.linalg.solve(normal + ridge, terms.mT @ y), used.sum(dim=1)


def _shrunk(fitted: Tensor, noise: Tensor) -> Tensor:
    """Shrink a fit ``(n, R, l)`` by the noise in its sum of squares, ``(n, l)``."""
    squares = fitted.square().sum(dim=1)
    shares = 1 - noise / squares.clamp_min(1e-300)
    return fitted * shares.clamp_min(0.0)[:, None]
