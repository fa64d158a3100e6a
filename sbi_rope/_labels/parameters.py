"""Draws of the parameters that labels leave possible, under the prior."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_rope._bounds import bounds_of
from sbi_rope._labels.labels import Labels
from sbi_rope._labels.nodes import Nodes, Reference, place_nodes, reference_of
from sbi_rope._random import seeded
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.mixture.prior import prior_log_prob, prior_sample

__all__ = ["LabelledParameters", "nodes_of", "parameters_of"]

# Draws from the prior, for its moments.
NUM_PRIOR_DRAWS = 5000
# Proposals for each label, from which the draws are chosen, and the draws.
NUM_PROPOSALS, NUM_DRAWS = 2000, 100
# With fewer effective proposals the draws repeat each other, and there is a warning.
SMALLEST_SIZE = 20.0
# A noisy label that misses the prior's support by more standard deviations is refused.
LARGEST_MISS = 8.0
# With fewer nodes inside the prior's support, a label gets others.
FEWEST_INSIDE = 4
# The number of labels that are treated at a time.
CHUNK_SIZE = 100


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledParameters:
    r"""Draws from :math:`p(\theta \mid y) \propto p(\theta)\, p(y \mid \theta)`.

    Attributes:
        draws: Shape ``(n, R, d)``. For exact labels R is 1.
    """

    draws: Tensor

    def __getitem__(self, rows: Tensor) -> "LabelledParameters":
        return LabelledParameters(draws=self.draws[rows])

    @property
    def are_exact(self) -> bool:
        """Whether all parameters are known exactly."""
        return self.draws.shape[1] == 1

    @property
    def mean(self) -> Tensor:
        """The mean of each label's parameters, shape ``(n, d)``."""
        if self.are_exact:
            return self.draws[:, 0]
        return self.draws.double().mean(dim=1).to(self.draws)


def parameters_of(labels: Labels, prior: Any) -> LabelledParameters:
    """Draw the parameters of labels, by importance sampling.

    The draws of a label do not depend on the values of other labels.

    Args:
        labels: The labels.
        prior: The prior of NPE.

    Raises:
        InvalidInputError: If no parameters inside the prior's support fit a label.
    """
    if labels.samples is not None:
        return LabelledParameters(draws=_shuffled(labels.samples))
    if labels.are_exact:
        return LabelledParameters(draws=labels.theta[:, None])
    reference = _prior_reference(prior, labels.theta)
    parts = []
    for number, rows in enumerate(torch.arange(len(labels)).split(CHUNK_SIZE)):
        # Other proposals for each chunk, so that their errors average out.
        with seeded(number):
            parts.append(_draw(labels[rows], prior, reference, first=int(rows[0])))
    return LabelledParameters(draws=torch.cat(parts))


def nodes_of(
    labels: Labels, references: list[Reference], prior: Any, *, num_nodes: int
) -> Nodes:
    r"""Return the nodes at which the densities of labels are computed.

    Of labels given as draws, these are the draws, weighted by
    :math:`1 / p(\theta)`, so that scores are relative to those of the prior.

    Args:
        labels: The labels.
        references: As in :func:`place_nodes`. The prior is added to them, and takes
            the place of what is not finite.
        prior: The prior of NPE.
        num_nodes: The number of nodes of each label, at least.
    """
    if labels.samples is not None:
        log_prior = prior_log_prob(prior, labels.samples).double()
        return Nodes(theta=labels.samples, log_weights=-log_prior)
    n = len(labels)
    one = _prior_reference(prior, labels.theta)
    wide = Reference(
        mean=one.mean.expand(n, -1), covariance=one.covariance.expand(n, -1, -1)
    )
    usable = [reference.or_else(wide) for reference in references]
    nodes = place_nodes(labels, [*usable, wide], prior, num_nodes=num_nodes)
    inside = torch.isfinite(nodes.log_weights).sum(dim=1)
    few = (inside < FEWEST_INSIDE).nonzero().flatten()
    for rows in few.split(CHUNK_SIZE) if len(few) else ():
        others = _nodes_inside(labels[rows], wide[rows], prior, nodes.theta.shape[1])
        nodes.theta[rows] = others.theta
        nodes.log_weights[rows] = others.log_weights
    return nodes


def _nodes_inside(labels: Labels, wide: Reference, prior: Any, count: int) -> Nodes:
    r"""Return nodes drawn from :math:`p(\theta \mid y)`, which is inside the support.

    Their weights are :math:`p(y) / p(\theta)`. Labels that no parameters fit keep
    weights of zero.
    """
    nodes, log_prior = _proposals(labels, wide, prior)
    log_posterior = nodes.log_weights + log_prior
    log_evidence = log_posterior.logsumexp(dim=1) - math.log(log_posterior.shape[1])
    found = torch.isfinite(log_evidence)
    shares = torch.softmax(log_posterior[found], dim=1)
    chosen = _systematic(shares, count)
    theta = nodes.theta[:, :count].clone()
    theta[found] = nodes.theta[found].gather(
        1, chosen[..., None].expand(-1, -1, theta.shape[2])
    )
    log_weights = torch.full_like(log_posterior[:, :count], -torch.inf)
    log_weights[found] = log_evidence[found, None] - log_prior[found].gather(1, chosen)
    return Nodes(theta=theta, log_weights=log_weights)


def _proposals(labels: Labels, wide: Reference, prior: Any) -> tuple[Nodes, Tensor]:
    """Return proposals for labels, and the log density of the prior at each."""
    nodes = place_nodes(labels, [wide], prior, num_nodes=NUM_PROPOSALS)
    return nodes, prior_log_prob(prior, nodes.theta).double()


def _prior_reference(prior: Any, like: Tensor) -> Reference:
    """Return the mean and the covariance of the prior, for one label."""
    with seeded(0):
        samples = prior_sample(prior, torch.Size((NUM_PRIOR_DRAWS,))).to(like)
    return reference_of(samples[:, None])


def _draw(labels: Labels, prior: Any, reference: Reference, *, first: int) -> Tensor:
    n = len(labels)
    wide = Reference(
        mean=reference.mean.expand(n, -1),
        covariance=reference.covariance.expand(n, -1, -1),
    )
    nodes, log_prior = _proposals(labels, wide, prior)
    log_weights = nodes.log_weights + log_prior
    lost = torch.isneginf(log_weights).all(dim=1) | _are_far_outside(labels, prior)
    if lost.any():
        rows = (lost.nonzero().flatten()[:5] + first).tolist()
        raise InvalidInputError(
            "Expected labels that some parameters inside the support of the prior "
            f"fit; got {int(lost.sum())} others (first: {rows}). Check the units."
        )
    shares = torch.softmax(log_weights, dim=1)
    size = 1.0 / shares.square().sum(dim=1)
    known = ~(~labels.is_measured | labels.is_noisy).any(dim=1)
    size = size.where(~known, torch.full_like(size, torch.inf))
    if bool((size < SMALLEST_SIZE).any()):
        rows = ((size < SMALLEST_SIZE).nonzero().flatten()[:5] + first).tolist()
        warn_user(
            f"The labels {rows} are hardly plausible under the prior: fewer than "
            f"{SMALLEST_SIZE:.0f} effective draws fit."
        )
    chosen = _systematic(shares, NUM_DRAWS)
    return nodes.theta.gather(
        1, chosen[..., None].expand(-1, -1, labels.theta.shape[1])
    )


def _are_far_outside(labels: Labels, prior: Any) -> Tensor:
    """Tell which noisy labels miss the prior's support by many standard deviations."""
    y = labels.theta.double()
    low, high = bounds_of(prior, y[0])
    std = labels.covariance.diagonal(dim1=1, dim2=2).sqrt()
    missed = torch.maximum(low - y, y - high)
    return (labels.is_noisy & (missed > LARGEST_MISS * std)).any(dim=1)


def _shuffled(samples: Tensor) -> Tensor:
    """Return draws in random order, a few of them repeatedly, ``(n, R, d)``.

    Any part of the draws represents all of them then, also if they were sorted. All
    are repeated equally often. With repetitions there are enough simulations for each
    label to tell what is noise.
    """
    count = samples.shape[1]
    with seeded(0):
        rounds = [torch.randperm(count) for _ in range(-(-NUM_DRAWS // count))]
    return samples[:, torch.cat(rounds).to(samples.device)]


def _systematic(shares: Tensor, count: int) -> Tensor:
    """Choose columns of each row by their shares, evenly; shape ``(n, count)``."""
    steps = (torch.arange(count).to(shares) + 0.5) / count
    upper = shares.cumsum(dim=1)
    upper = upper / upper[:, -1:]
    order = torch.searchsorted(upper, steps.expand(len(shares), -1).contiguous())
    # In random order, so that any part of the draws represents all of them.
    shuffled = torch.rand(len(shares), count).argsort(dim=1).to(shares.device)
    return order.gather(1, shuffled).clamp_max(shares.shape[1] - 1)
