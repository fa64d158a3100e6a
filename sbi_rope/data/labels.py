r"""Labels that are not exact: how users pass them, draws given them, their densities.

The density of a label y given x averages a posterior over what the label leaves open,

.. math:: p(y \mid x) = \int q(\theta \mid x)\, p(y \mid \theta)\, d\theta ,

where exact parameters are fixed and :math:`p(y \mid \theta)` is one for missing ones.
It is estimated by importance sampling from a mixture of Student t distributions, each a
reference posterior, taken for normal and updated with the label as in a Kalman filter.
References are the posteriors to be scored and the prior, so that no density is much
larger than the mixture.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Chi2, MultivariateNormal

from sbi_rope.data.pairs import Labels, Nodes
from sbi_rope.npe.prior import PriorDistribution, check_in_support
from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import default_names
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# A covariance may be this much asymmetric, relative to its diagonal, and a correlation
# with a smaller eigenvalue than the second number is singular.
ROUNDING, SINGULAR = 1e-6, 1e-12
# A larger share of labels on a bound is no accident of rounding.
MANY_ON_BOUNDS = 0.05
# Draws from the prior for its moments, proposals for each label, and draws of it.
NUM_PRIOR_DRAWS, NUM_PROPOSALS, NUM_DRAWS = 5000, 2000, 100
# Labels with fewer effective proposals are warned of. Noisy ones that miss the prior's
# support by so many standard deviations are refused.
SMALLEST_SIZE, LARGEST_MISS = 20.0, 8.0
# With fewer nodes inside the prior's support, a label gets others.
FEWEST_INSIDE = 4
# So many labels are treated at a time.
CHUNK_SIZE = 100
# Degrees of freedom of the proposals, whose tails are heavier than those of posteriors,
# and the share of a variance that is added to it, so that none is zero.
FREEDOM, JITTER = 5.0, 1e-6


# What users pass ----------------------------------------------------------------------


def given_labels(
    theta: Any,
    *,
    theta_std: Any,
    theta_cov: Any,
    like: Tensor,
    prior: PriorDistribution,
    names: Sequence[str] | None,
) -> Labels:
    """Return labels, like ``like``, from the arguments of ``append_calibration``."""
    dim = like.shape[1]
    theta = as_numbers("theta", theta, device=like.device, names=names)
    event_shape = (theta.shape[1], dim) if theta.ndim == 3 else (dim,)
    theta = as_batch("theta", theta, event_shape, finite=False)
    theta = theta.to(like.dtype, copy=True)
    if (infinite := torch.isinf(theta)).any():
        raise InvalidInputError(
            "Expected `theta` to be finite, or NaN where it was not measured; got Inf "
            f"in {rows_with(infinite)}."
        )
    if theta.ndim == 3:
        has_noise = theta_std is not None or theta_cov is not None
        if has_noise or torch.isnan(theta).any():
            raise InvalidInputError(
                "Expected draws of all parameters, without NaN, `theta_std` and "
                f"`theta_cov`; got `theta` of shape {tuple(theta.shape)} with some."
            )
        check_in_support("theta", theta.reshape(-1, dim), prior)
        mean = Labels.exact(theta.double().mean(dim=1).to(theta))
        return replace(mean, draws=theta)
    covariance = _given_covariance(~torch.isnan(theta), theta_std, theta_cov, names)
    labels = replace(Labels.exact(theta), covariance=covariance)
    # Noise may move a label out of the prior, but an exact one must be inside.
    check_in_support("theta", theta, prior, rows=labels.is_exact)
    return labels


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


def _given_covariance(
    measured: Tensor, theta_std: Any, theta_cov: Any, names: Sequence[str] | None
) -> Tensor:
    """Return the covariance of each label, zero for what was not measured."""
    n, d = measured.shape
    device = measured.device
    if theta_std is not None and theta_cov is not None:
        raise InvalidInputError("Expected `theta_std` or `theta_cov`; got both.")
    if theta_cov is None:
        std: Any = 0.0 if theta_std is None else theta_std
        std = as_numbers("theta_std", std, device=device, names=names)
        std = _expanded("theta_std", std, (), (d,), (n, d)).where(measured, 0.0)
        if (bad := ~(torch.isfinite(std) & (std >= 0))).any():
            raise InvalidInputError(
                "Expected `theta_std` to be finite and not negative; got "
                f"{std[bad][0]:g}."
            )
        return torch.diag_embed(std.square())
    covariance = as_numbers("theta_cov", theta_cov, device=device)
    covariance = _expanded("theta_cov", covariance, (d, d), (n, d, d))
    covariance = covariance.where(measured[:, :, None] & measured[:, None, :], 0.0)
    # Relative to the standard deviations, because parameters may have different units.
    variance = covariance.diagonal(dim1=1, dim2=2)
    noisy = variance > 0
    std = variance.where(noisy, 1.0).sqrt()
    correlation = covariance / (std[:, :, None] * std[:, None, :])
    # Noisy parameters may have no direction without noise, which has no density.
    regular = (correlation + correlation.mT) / 2 + torch.diag_embed((~noisy).double())
    bad = ~((correlation - correlation.mT).abs().amax(dim=(1, 2)) <= ROUNDING)
    bad |= torch.linalg.eigvalsh(regular.nan_to_num())[:, 0] <= SINGULAR
    if bad.any():
        raise InvalidInputError(
            "Expected `theta_cov` to be finite, symmetric, and positive definite for "
            f"the noisy parameters; got another one in {rows_with(bad)}."
        )
    return (covariance + covariance.mT) / 2


def _expanded(name: str, value: Tensor, *shapes: tuple[int, ...]) -> Tensor:
    """Return a value of one of these shapes in the last of them, float64."""
    if tuple(value.shape) not in shapes:
        raise InvalidInputError(
            f"Expected `{name}` of shape {' or '.join(map(str, shapes))}; got "
            f"{tuple(value.shape)}."
        )
    return value.double().expand(shapes[-1])


def on_bounds(
    labels: Labels, prior: PriorDistribution, names: Sequence[str] | None
) -> list[str]:
    """Say of which parameters many exact labels are on a bound of the prior."""
    if labels.are_drawn:
        return []
    exact = labels.is_measured & ~labels.is_noisy
    on_bound = exact & (labels.y != prior.off_bounds(labels.y))
    counts, numbers = on_bound.sum(dim=0), exact.sum(dim=0)
    many = (counts > 1) & (counts > MANY_ON_BOUNDS * numbers)
    names = names or default_names(len(many))
    return [
        f"{int(counts[j])} of {int(numbers[j])} labels of {names[j]}"
        for j in many.nonzero().flatten().tolist()
    ]


# Draws of parameters ------------------------------------------------------------------


def draws_of(labels: Labels, prior: PriorDistribution) -> Tensor:
    r"""Draw from :math:`p(\theta \mid y) \propto p(\theta)\, p(y \mid \theta)`.

    The draws of a label, ``(n, S, d)``, do not depend on the values of other labels. S
    is 1 if all labels are exact.
    """
    if labels.are_drawn:
        # In random order, all of them equally often, at least 100 in all.
        count = labels.draws.shape[1]
        with seeded(0):
            rounds = [torch.randperm(count) for _ in range(-(-NUM_DRAWS // count))]
        return labels.draws[:, torch.cat(rounds).to(labels.draws.device)]
    if labels.are_exact:
        return labels.y[:, None]
    parts = []
    for number, rows in enumerate(torch.arange(len(labels)).split(CHUNK_SIZE)):
        # Other proposals for each chunk, so that their errors average out.
        with seeded(number):
            parts.append(_drawn(labels[rows], prior, first=int(rows[0])))
    return torch.cat(parts)


def _drawn(labels: Labels, prior: PriorDistribution, *, first: int) -> Tensor:
    """Draw parameters of labels, the first of which is the row ``first``."""
    nodes, log_posterior = _proposals(labels, prior)
    # Labels that miss the support by many standard deviations fit nothing, either.
    y = labels.y.double()
    low, high = prior.bounds(y[0])
    std = labels.covariance.diagonal(dim1=1, dim2=2).sqrt()
    missed = torch.maximum(low - y, y - high) > LARGEST_MISS * std
    lost = torch.isneginf(log_posterior).all(dim=1)
    lost |= (labels.is_noisy & missed).any(dim=1)
    if lost.any():
        rows = (lost.nonzero().flatten()[:5] + first).tolist()
        raise InvalidInputError(
            "Expected labels that some parameters inside the support of the prior "
            f"fit; got {int(lost.sum())} others (first: {rows}). Check the units."
        )
    shares = torch.softmax(log_posterior, dim=1)
    few = ~labels.is_exact & (1.0 / shares.square().sum(dim=1) < SMALLEST_SIZE)
    if few.any():
        rows = (few.nonzero().flatten()[:5] + first).tolist()
        warn_user(
            f"The labels {rows} are hardly plausible under the prior: fewer than "
            f"{SMALLEST_SIZE:.0f} effective draws fit."
        )
    chosen = _systematic(shares, NUM_DRAWS)
    return nodes.theta.take_along_dim(chosen[..., None], 1)


def _proposals(labels: Labels, prior: PriorDistribution) -> tuple[Nodes, Tensor]:
    """Return proposals for labels, and their log densities given the label."""
    nodes = place_nodes(
        labels, [_prior_reference(labels, prior)], prior, num_nodes=NUM_PROPOSALS
    )
    log_prior = prior.log_prob(nodes.theta).double()
    return nodes, nodes.log_weights + log_prior


def _systematic(shares: Tensor, count: int) -> Tensor:
    """Choose columns of each row by their shares, evenly; shape ``(n, count)``."""
    steps = (torch.arange(count).to(shares) + 0.5) / count
    upper = shares.cumsum(dim=1)
    upper = upper / upper[:, -1:]
    order = torch.searchsorted(upper, steps.expand(len(shares), -1).contiguous())
    # In random order, so that any part of the draws represents all of them.
    shuffled = torch.rand(len(shares), count).argsort(dim=1).to(shares.device)
    return order.gather(1, shuffled).clamp_max(shares.shape[1] - 1)


# Densities of labels ------------------------------------------------------------------


class Reference(NamedTuple):
    """Moments of a density at each observation: ``(n, d)`` and ``(n, d, d)``."""

    mean: Tensor
    covariance: Tensor


def reference_of(samples: Tensor) -> Reference:
    """Return the moments of samples of each observation, shape ``(M, n, d)``."""
    samples = samples.double()
    mean = samples.mean(dim=0)
    centred = (samples - mean).movedim(0, 1)
    return Reference(mean, centred.mT @ centred / max(1, samples.shape[0] - 1))


def nodes_of(
    labels: Labels,
    references: Sequence[Reference],
    prior: PriorDistribution,
    *,
    num_nodes: int,
) -> Nodes:
    r"""Return the nodes at which the densities of labels are computed.

    Of labels given as draws, these are the draws, weighted by
    :math:`1 / p(\theta)`, so that scores are relative to those of the prior. Others
    have at least ``num_nodes``. The ``references`` are moments of the densities at
    the observation of each label. Those of the prior are added, and replace what is not
    finite.
    """
    if labels.are_drawn:
        log_prior = prior.log_prob(labels.draws).double()
        return Nodes(theta=labels.draws, log_weights=-log_prior)
    wide = _prior_reference(labels, prior)
    usable = []
    for mean, covariance in references:
        finite = torch.isfinite(torch.cat([mean, covariance.flatten(1)], dim=1))
        finite = finite.all(dim=1)[:, None]
        mean = mean.where(finite, wide.mean)
        covariance = covariance.where(finite[..., None], wide.covariance)
        usable.append(Reference(mean, covariance))
    nodes = place_nodes(labels, [*usable, wide], prior, num_nodes=num_nodes)
    inside = torch.isfinite(nodes.log_weights).sum(dim=1)
    few = (inside < FEWEST_INSIDE).nonzero().flatten()
    for rows in few.split(CHUNK_SIZE) if len(few) else ():
        others = _nodes_inside(labels[rows], prior, nodes.theta.shape[1])
        nodes.theta[rows] = others.theta
        nodes.log_weights[rows] = others.log_weights
    return nodes


def _nodes_inside(labels: Labels, prior: PriorDistribution, count: int) -> Nodes:
    r"""Return nodes drawn from :math:`p(\theta \mid y)`, which is inside the support.

    Their weights are :math:`p(y) / p(\theta)`, zero for labels that no parameters fit.
    """
    nodes, log_posterior = _proposals(labels, prior)
    log_evidence = log_posterior.logsumexp(dim=1) - math.log(log_posterior.shape[1])
    found = torch.isfinite(log_evidence)
    chosen = _systematic(torch.softmax(log_posterior[found], dim=1), count)
    theta = nodes.theta[:, :count].clone()
    theta[found] = nodes.theta[found].take_along_dim(chosen[..., None], 1)
    log_prior = (log_posterior - nodes.log_weights)[found].gather(1, chosen)
    log_weights = torch.full_like(log_posterior[:, :count], -torch.inf)
    log_weights[found] = log_evidence[found, None] - log_prior
    return Nodes(theta=theta, log_weights=log_weights)


def _prior_reference(labels: Labels, prior: PriorDistribution) -> Reference:
    """Return the moments of the prior, the same for each label."""
    with seeded(0):
        samples = prior.sample((NUM_PRIOR_DRAWS,)).to(labels.y)
    mean, covariance = reference_of(samples[:, None])
    n = len(labels)
    return Reference(mean.expand(n, -1), covariance.expand(n, -1, -1))


def place_nodes(
    labels: Labels,
    references: Sequence[Reference],
    prior: PriorDistribution,
    *,
    num_nodes: int,
) -> Nodes:
    """Draw nodes of measurements, weighted zero outside the support of the prior."""
    n, d = labels.y.shape
    of_each = max(1, math.ceil(num_nodes / len(references)))
    total = of_each * len(references)
    theta = labels.y.double()[:, None].expand(n, total, d).clone()
    log_weights = labels.covariance.new_zeros(n, total)
    low, high = prior.bounds(log_weights.new_zeros(d))
    pattern = torch.cat(
        [~labels.is_measured | labels.is_noisy, labels.is_measured], dim=1
    )
    # Labels that leave the same parameters open are treated together.
    for one in pattern.unique(dim=0):
        free, measured = (part.nonzero().flatten() for part in one.split(d))
        noisy = (one[:d] & one[d:]).nonzero().flatten()
        if not len(free):
            continue
        rows = (pattern == one).all(dim=1).nonzero().flatten()
        some = labels[rows]
        parts: list[tuple[Tensor, Tensor]] = []
        for mean, covariance in references:
            mean, factor = _updated(some, mean[rows], covariance[rows], measured, free)
            parts.append((mean.maximum(low[free]).minimum(high[free]), factor))
        drawn = torch.cat([_sample_t(*part, of_each) for part in parts], dim=1)
        log_t = torch.stack([_log_t(drawn, *part) for part in parts]).logsumexp(dim=0)
        theta[rows[:, None, None], torch.arange(total)[:, None], free] = drawn
        log_weights[rows] = math.log(len(parts)) - log_t
        if len(noisy):
            noise = some.covariance[:, noisy][:, :, noisy]
            noise = torch.linalg.cholesky(noise)[:, None]
            at = theta[rows][..., noisy]
            likelihood = MultivariateNormal(at, scale_tril=noise, validate_args=False)
            y = some.y.double()[:, None, noisy]
            log_weights[rows] += likelihood.log_prob(y)
    theta, inside = prior.moved_inside(theta.to(labels.y).reshape(-1, d))
    return Nodes(
        theta=theta.reshape(n, total, d),
        log_weights=log_weights.where(inside.reshape(n, total), -torch.inf),
    )


def _updated(
    labels: Labels, mean: Tensor, covariance: Tensor, measured: Tensor, free: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean and Cholesky factor of the open parameters given the label."""
    scale = covariance.diagonal(dim1=1, dim2=2).clamp_min(1e-300)
    covariance = covariance + JITTER * torch.diag_embed(scale)
    noise = labels.covariance[:, measured][:, :, measured]
    total = covariance[:, measured][:, :, measured] + noise
    cross = covariance[:, free][:, :, measured]
    gain = torch.linalg.solve(total, cross, left=False)
    surprise = labels.y.double()[:, measured] - mean[:, measured]
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
    """Draw from a multivariate Student t distribution."""
    n, width = mean.shape
    normal = torch.randn(n, count, width, dtype=torch.double).to(mean)
    chi2 = Chi2(torch.tensor(FREEDOM, dtype=torch.double)).sample((n, count, 1))
    scaled = normal * (FREEDOM / chi2.to(mean)).sqrt()
    return mean[:, None] + scaled @ factor.mT


def _log_t(theta: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """Return the log density of a multivariate Student t distribution."""
    width = mean.shape[1]
    centred = (theta - mean[:, None]).mT
    squares = torch.linalg.solve_triangular(factor, centred, upper=False).square()
    return (
        math.lgamma((FREEDOM + width) / 2)
        - math.lgamma(FREEDOM / 2)
        - width / 2 * math.log(FREEDOM * math.pi)
        - factor.diagonal(dim1=1, dim2=2).log().sum(dim=1, keepdim=True)
        - (FREEDOM + width) / 2 * torch.log1p(squares.sum(dim=1) / FREEDOM)
    )
