r"""Labels that are not exact: how users pass them, draws given them, their densities.

The density of a label y given x averages a posterior over what the label leaves open,

.. math:: p(y \mid x) = \int q(\theta \mid x)\, p(y \mid \theta)\, d\theta ,

where exact parameters are fixed and :math:`p(y \mid \theta)` is one for missing ones.
It is estimated by importance sampling from a mixture of Student t distributions: the
posteriors to be scored and the prior, each taken for normal and updated with the label
as in a Kalman filter, so that no density is much larger than the mixture.
"""

import math
from collections.abc import Hashable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Chi2, Normal

from sbi_rope.data.pairs import Nodes, Pairs
from sbi_rope.npe.prior import PriorDistribution, check_in_support
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# Draws from the prior for its moments, proposals for each label, and draws of it.
NUM_PRIOR_DRAWS, NUM_PROPOSALS, NUM_DRAWS = 5000, 2000, 100
# Labels that miss the prior's support by so many standard deviations are refused.
LARGEST_MISS = 8.0
# With fewer nodes inside the prior's support, a label gets others.
FEWEST_INSIDE = 4
# So many labels are treated at a time.
CHUNK_SIZE = 100
# Degrees of freedom of the proposals, whose tails are heavier than those of posteriors,
# and the share of a variance that is added to it, so that none is zero.
FREEDOM, JITTER = 5.0, 1e-6

# Means ``(n, d)``, and covariances or their Cholesky factors ``(n, d, d)``.
Moments = tuple[Tensor, Tensor]


def given_labels(
    theta: Any,
    theta_std: Any,
    *,
    like: Tensor,
    prior: PriorDistribution,
    names: Sequence[str] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the attributes theta, y and std of :class:`Pairs`, like ``like``."""
    dim = like.shape[1]
    theta = as_numbers("theta", theta, device=like.device, names=names)
    if theta.ndim == 3:
        if theta_std is not None:
            raise InvalidInputError("Expected no `theta_std` of labels given as draws.")
        draws = as_batch("theta", theta, (theta.shape[1], dim)).to(like.dtype)
        check_in_support("theta", draws.reshape(-1, dim), prior)
        with seeded(0):
            order = torch.randperm(draws.shape[1]).to(draws.device)
        y = draws.double().mean(dim=1)
        return draws[:, order], y.to(draws), torch.full_like(y, torch.nan)
    y = as_batch("theta", theta, (dim,), finite=False).to(like.dtype, copy=True)
    is_measured = ~torch.isnan(y)
    as_batch("theta", y.where(is_measured, 0.0))  # Inf is no measurement
    std = 0.0 if theta_std is None else theta_std
    std = as_numbers("theta_std", std, device=like.device, names=names)
    if std.shape in ((), (dim,)):
        std = std.expand(y.shape)
    std = as_batch("theta_std", std, (dim,), rows=len(y), finite=False)
    std = as_batch("theta_std", std.where(is_measured, 0.0)).double()
    if (bad := std < 0).any():
        raise InvalidInputError(
            f"Expected `theta_std` not to be negative; got others in {rows_with(bad)}."
        )
    # Noise may move a label out of the prior, but an exact one must be inside.
    is_exact = (is_measured & (std == 0)).all(dim=1)
    check_in_support("theta", y, prior, rows=is_exact)
    return y[:, None], y, std


def given_weights(weights: Any, n: int, device: torch.device) -> Tensor:
    """Return how many pairs each of n pairs counts as; one if None."""
    if weights is None:
        return torch.ones(n, dtype=torch.double, device=device)
    weights = as_batch("weights", weights, (), rows=n, device=device)
    if (bad := weights <= 0).any():
        raise InvalidInputError(
            f"Expected positive `weights`; got others in {rows_with(bad)}."
        )
    return weights.double()


def given_groups(groups: Any, n: int) -> tuple[Hashable, ...]:
    """Return the names of the groups of n pairs, and none if None."""
    if groups is None:
        return ()
    # Tensors and arrays become Python's numbers, which are equal if they are.
    names = tuple(groups.tolist() if hasattr(groups, "tolist") else groups)
    if len(names) != n or any(name is None or name != name for name in names):
        raise InvalidInputError(
            f"Expected `groups` with one number or name for each of {n} pairs; got "
            f"{len(names)}, or some that are missing."
        )
    return names


def draws_of(pairs: Pairs, prior: PriorDistribution) -> Tensor:
    r"""Draw from :math:`p(\theta \mid y) \propto p(\theta)\, p(y \mid \theta)`.

    The draws of a label, ``(n, S, d)``, do not depend on the values of other labels. S
    is 1 if all labels are exact.
    """
    if pairs.are_drawn:
        return pairs.theta
    if pairs.are_exact:
        return pairs.y[:, None]
    y, parts, possible = pairs.y.double(), [], []
    for number, rows in enumerate(torch.arange(len(pairs)).split(CHUNK_SIZE)):
        # Other proposals for each chunk, so that their errors average out.
        with seeded(number):
            nodes, log_posterior = _proposals(pairs[rows], prior)
            # NaN where the label fits nothing, see below.
            shares = torch.softmax(log_posterior, dim=1).nan_to_num(1.0).cpu()
            chosen = shares.multinomial(NUM_DRAWS, replacement=True).to(y.device)
        parts.append(nodes.theta.take_along_dim(chosen[..., None], 1))
        possible.append(torch.isfinite(log_posterior).any(dim=1))
    # Labels that miss the support by many standard deviations fit nothing, either.
    low, high = prior.bounds(y[0])
    missed = torch.maximum(low - y, y - high) > LARGEST_MISS * pairs.std
    lost = ~torch.cat(possible) | ((pairs.std > 0) & missed).any(dim=1)
    if lost.any():
        raise InvalidInputError(
            "Expected labels that some parameters inside the support of the prior "
            f"fit; got others in {rows_with(lost)}. Check the units."
        )
    return torch.cat(parts)


def _proposals(pairs: Pairs, prior: PriorDistribution) -> tuple[Nodes, Tensor]:
    """Return proposals for labels, and their log densities given the label."""
    nodes = _place_nodes(pairs, [], prior, num_nodes=NUM_PROPOSALS)
    return nodes, nodes.log_weights + prior.log_prob(nodes.theta).double()


def nodes_of(
    pairs: Pairs, samples: Sequence[Tensor], prior: PriorDistribution, *, num_nodes: int
) -> Nodes:
    r"""Return the nodes at which the densities of labels are computed.

    Labels given as draws have these, weighted by :math:`1 / p(\theta)`, so that scores
    are relative to those of the prior. Others have at least ``num_nodes``. The
    ``samples`` are those of each density at the observations, ``(M, n, d)``.
    """
    if pairs.are_drawn:
        log_prior = prior.log_prob(pairs.theta).double()
        return Nodes(theta=pairs.theta, log_weights=-log_prior)
    nodes = _place_nodes(pairs, samples, prior, num_nodes=num_nodes)
    inside = torch.isfinite(nodes.log_weights).sum(dim=1)
    few = (inside < FEWEST_INSIDE).nonzero().flatten()
    for rows in few.split(CHUNK_SIZE) if len(few) else ():
        # Draws given the label are inside; their weights are p(y) / p(theta).
        theta = pairs.theta[rows]
        theta = theta[:, torch.arange(nodes.theta.shape[1]) % theta.shape[1]]
        _, log_posterior = _proposals(pairs[rows], prior)
        log_evidence = log_posterior.logsumexp(dim=1) - math.log(NUM_PROPOSALS)
        nodes.theta[rows] = theta
        nodes.log_weights[rows] = log_evidence[:, None] - prior.log_prob(theta).double()
    return nodes


def _references(
    pairs: Pairs, samples: Sequence[Tensor], prior: PriorDistribution
) -> list[Moments]:
    """Return moments of densities and of the prior, which replace those not finite."""
    with seeded(0):
        of_prior = prior.sample((NUM_PRIOR_DRAWS, 1)).expand(-1, len(pairs), -1)
    found: list[Moments] = []
    for draws in (*samples, of_prior.to(pairs.y)):
        mean = draws.double().mean(dim=0)
        centred = (draws.double() - mean).movedim(0, 1)
        found.append((mean, centred.mT @ centred / max(1, len(draws) - 1)))
    for mean, covariance in found[:-1]:
        bad = ~torch.isfinite(torch.cat([mean, covariance.flatten(1)], dim=1))
        bad = bad.any(dim=1)
        mean[bad], covariance[bad] = found[-1][0][bad], found[-1][1][bad]
    return found


def _place_nodes(
    pairs: Pairs, samples: Sequence[Tensor], prior: PriorDistribution, *, num_nodes: int
) -> Nodes:
    """Draw nodes of measurements, weighted zero outside the support of the prior."""
    references, (n, d) = _references(pairs, samples, prior), pairs.y.shape
    of_each = math.ceil(num_nodes / len(references))
    total = of_each * len(references)
    y, is_noisy = pairs.y.double(), pairs.std > 0
    theta, log_weights = y[:, None].repeat(1, total, 1), y.new_zeros(n, total)
    low, high = prior.bounds(y.new_zeros(d))
    pattern = torch.cat([~pairs.is_measured | is_noisy, pairs.is_measured], dim=1)
    # Labels that leave the same parameters open are treated together.
    for one in pattern.unique(dim=0):
        free, measured = (part.nonzero().flatten() for part in one.split(d))
        noisy = (one[:d] & one[d:]).nonzero().flatten()
        if not len(free):
            continue
        rows = (pattern == one).all(dim=1).nonzero().flatten()
        parts: list[Moments] = []
        for mean, covariance in references:
            mean, factor = _updated(
                pairs[rows], mean[rows], covariance[rows], measured, free
            )
            parts.append((mean.maximum(low[free]).minimum(high[free]), factor))
        drawn = torch.cat([_sample_t(*part, of_each) for part in parts], dim=1)
        log_t = [log_student_t(drawn, *part, FREEDOM) for part in parts]
        theta[rows[:, None, None], torch.arange(total)[:, None], free] = drawn
        noise = pairs.std[rows][:, None, noisy]
        likelihood = Normal(theta[rows][..., noisy], noise, validate_args=False)
        log_weights[rows] = (
            likelihood.log_prob(y[rows][:, None, noisy]).sum(dim=2)
            + math.log(len(parts))
            - torch.stack(log_t).logsumexp(dim=0)
        )
    theta, inside = prior.moved_inside(theta.to(pairs.y).reshape(-1, d))
    return Nodes(
        theta=theta.reshape(n, total, d),
        log_weights=log_weights.where(inside.reshape(n, total), -torch.inf),
    )


def _updated(
    pairs: Pairs, mean: Tensor, covariance: Tensor, measured: Tensor, free: Tensor
) -> Moments:
    """Return mean and Cholesky factor of the open parameters given the label."""
    scale = covariance.diagonal(dim1=1, dim2=2).clamp_min(1e-300)
    covariance = covariance + JITTER * torch.diag_embed(scale)
    noise = torch.diag_embed(pairs.std[:, measured].square())
    total = covariance[:, measured][:, :, measured] + noise
    cross = covariance[:, free][:, :, measured]
    gain = torch.linalg.solve(total, cross, left=False)
    surprise = pairs.y.double()[:, measured] - mean[:, measured]
    mean = mean[:, free] + (gain @ surprise[..., None])[..., 0]
    # The form of Joseph, which is a sum. A difference loses the precision of labels
    # that are nearly exact.
    every = torch.eye(covariance.shape[1]).to(covariance)
    kept = every[free] - gain @ every[measured]
    left = kept @ covariance @ kept.mT + gain @ noise @ gain.mT
    std = left.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    correlation = left / (std[:, :, None] * std[:, None, :])
    variance, directions = torch.linalg.eigh((correlation + correlation.mT) / 2)
    correlation = directions * variance.clamp_min(JITTER)[:, None] @ directions.mT
    return mean, std[:, :, None] * torch.linalg.cholesky(correlation)


def _sample_t(mean: Tensor, factor: Tensor, count: int) -> Tensor:
    n, width = mean.shape
    normal = torch.randn(n, count, width, dtype=torch.double).to(mean)
    chi2 = Chi2(torch.tensor(FREEDOM, dtype=torch.double)).sample((n, count, 1))
    scaled = normal * (FREEDOM / chi2.to(mean)).sqrt()
    return mean[:, None] + scaled @ factor.mT


def log_student_t(
    theta: Tensor, mean: Tensor, factor: Tensor, freedom: float
) -> Tensor:
    """Return the log density at theta ``(*batch, S, d)``, shape ``(*batch, S)``.

    The mean is ``(*batch, d)``, and the Cholesky factor ``(*batch, d, d)``.
    """
    width = mean.shape[-1]
    centred = (theta - mean[..., None, :]).mT
    squares = torch.linalg.solve_triangular(factor, centred, upper=False).square()
    return (
        math.lgamma((freedom + width) / 2)
        - math.lgamma(freedom / 2)
        - width / 2 * math.log(freedom * math.pi)
        - factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1, keepdim=True)
        - (freedom + width) / 2 * torch.log1p(squares.sum(dim=-2) / freedom)
    )
