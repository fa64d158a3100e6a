"""Targets and moments: what simulations at the parameters of pairs are like."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.data import Pairs
from sbi_rope.simulate import Embed, Source, Stored

__all__ = ["Moments", "draws", "moments", "targets"]

# A quadratic surface has so many simulations for each of its coefficients, at least.
SIMULATIONS_PER_COEFFICIENT = 3
# Strength of the ridge, relative to the number of simulations.
RIDGE = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Moments:
    """Means and covariance of the embeddings of simulations at the parameters of pairs.

    Attributes:
        means: Means at R parameters that the label of each pair leaves possible, shape
            ``(n, R, l)``, float64. R is 1 if all labels are exact.
        covariance: That of simulations at one parameter, ``(n, l, l)``, float64.
    """

    means: Tensor
    covariance: Tensor

    @property
    def mean(self) -> Tensor:
        """The mean over the possible parameters, shape ``(n, l)``."""
        return self.means.mean(dim=1)

    def __getitem__(self, rows: Tensor) -> "Moments":
        return Moments(means=self.means[rows], covariance=self.covariance[rows])

    def columns(self, columns: slice) -> "Moments":
        """Return the moments of some entries of the embeddings."""
        return Moments(
            means=self.means[..., columns],
            covariance=self.covariance[:, columns, columns],
        )


def draws(
    source: Source, pairs: Pairs, count: int, embed: Embed, *, progress: bool = False
) -> tuple[Tensor, Tensor]:
    """Simulate at the draws of each pair, ``count`` times at exact parameters.

    A simulation that failed is replaced by another one of the pair.

    Returns:
        The parameters ``(n, S, d)``, and embeddings ``(n, S, l)``.
    """
    theta = pairs.theta
    if theta.shape[1] == 1:
        theta = theta.expand(-1, count, -1)
    z = source.at(theta, embed, progress=progress)
    failed = z.isnan().all(dim=2)
    if not failed.any():
        return theta, z
    # The k-th that failed is replaced by the k-th that is there.
    usable = failed.int().argsort(dim=1, stable=True)
    place = (failed.cumsum(dim=1) - 1).clamp_min(0)
    place = place % (~failed).sum(dim=1, keepdim=True)
    own = torch.arange(failed.shape[1], device=z.device).expand(failed.shape)
    chosen = own.where(~failed, usable.gather(1, place))[..., None]
    return theta.take_along_dim(chosen, 1), z.take_along_dim(chosen, 1)


def targets(
    source: Source,
    pairs: Pairs,
    count: int,
    embed: Embed,
    *,
    num_neighbors: int,
    progress: bool = False,
) -> Tensor:
    r"""Return :math:`E[h(S(\theta)) \mid y_i]`, the mean of ``count`` simulations.

    Over labels that are not exact it averages parameters, too. Of stored simulations,
    those with the ``num_neighbors`` nearest parameters count.

    Returns:
        Shape ``(n, l)``.
    """
    if isinstance(source, Stored) and pairs.are_exact:
        near = source.near(pairs.mean, num_neighbors, embed, progress=progress)
        return near.mean(dim=1)
    theta = pairs.theta[:, torch.arange(count) % pairs.theta.shape[1]]
    return source.at(theta, embed, progress=progress).nanmean(dim=1)


def moments(
    source: Source, pairs: Pairs, count: int, embed: Embed, *, progress: bool = False
) -> Moments:
    r"""Return the moments of simulations at the parameters of each pair.

    At exact parameters these are the moments of ``count`` simulations. Otherwise one
    simulation is made at each draw that the label leaves possible, and a surface is
    fitted to the simulations of each label, linear or, with enough draws, quadratic.
    Its values at the draws are the possible means. The covariance is that of the
    residuals.

    A surface also fits the noise of the simulations. Its linear and its quadratic terms
    are shrunk by how much of their size is noise, as James and Stein did, so that
    labels that are nearly exact have a single possible mean.

    References:
        | Estimation with Quadratic Loss (James and Stein, 1961)
        | https://projecteuclid.org/euclid.bsmsp/1200512173

    Args:
        source: Where simulations come from.
        pairs: The pairs.
        count: The number of simulations at each exact label.
        embed: The representation of simulations whose moments are returned.
        progress: Whether to show the progress of slow simulations.
    """
    theta, simulated = draws(source, pairs, count, embed, progress=progress)
    simulated = simulated.double()
    level = simulated.mean(dim=1, keepdim=True)
    residual = simulated - level
    freedom = simulated.new_full((len(theta),), theta.shape[1] - 1)
    fits = []
    for terms in [] if pairs.are_exact else _features(theta.double()):
        fitted, used = _regressed(residual, terms)
        residual = residual - fitted
        freedom = freedom - used
        fits.append((fitted, used))
    covariance = residual.mT @ residual / freedom.clamp_min(1.0)[:, None, None]
    noise = covariance.mean(dim=0).diagonal()
    means = level
    for fitted, used in fits:
        means = means + _shrunk(fitted, used[:, None] * noise)
    return Moments(means=means, covariance=covariance)


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

    Shapes ``(n, R, l)`` and ``(n, R, p)`` to ``(n, R, l)`` and ``(n,)``.
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
