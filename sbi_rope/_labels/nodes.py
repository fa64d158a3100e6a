r"""The density of a label under a posterior, by importance sampling.

The density of a label y given x is the average of the posterior's density over what the
label leaves open,

.. math:: p(y \mid x) = \int q(\theta \mid x)\, p(y \mid \theta)\, d\theta .

Over exact parameters there is nothing to integrate, and over missing ones
:math:`p(y \mid \theta)` is one. The integral is estimated at nodes from a mixture of
Student t distributions. Each of them is a reference posterior, taken for normal and
updated with the label by the formulas of the Kalman filter. Reference posteriors are
those to be scored, and the prior, so that no density is much larger than the mixture.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Chi2

from sbi_rope._bounds import bounds_of, moved_inside
from sbi_rope._labels.labels import Labels

__all__ = ["Nodes", "Reference", "place_nodes", "reference_of"]

# Degrees of freedom of the proposals. Their tails are heavier than those of the
# densities that are integrated.
FREEDOM = 5.0
# This share of a variance is added to it, so that no covariance is singular.
JITTER = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """The mean and the covariance of a density at each observation.

    Attributes:
        mean: Shape ``(n, d)``, float64.
        covariance: Shape ``(n, d, d)``, float64.
    """

    mean: Tensor
    covariance: Tensor

    def __getitem__(self, rows: Tensor) -> "Reference":
        return Reference(mean=self.mean[rows], covariance=self.covariance[rows])

    def or_else(self, other: "Reference") -> "Reference":
        """Return this reference, and another where this one is not finite."""
        finite = torch.isfinite(self.mean).all(dim=1)
        finite &= torch.isfinite(self.covariance).flatten(1).all(dim=1)
        return Reference(
            mean=self.mean.where(finite[:, None], other.mean),
            covariance=self.covariance.where(finite[:, None, None], other.covariance),
        )


def reference_of(samples: Tensor) -> Reference:
    """Return the moments of samples of each observation, shape ``(M, n, d)``."""
    samples = samples.double()
    mean = samples.mean(dim=0)
    centred = (samples - mean).movedim(0, 1)
    return Reference(
        mean=mean, covariance=centred.mT @ centred / max(1, samples.shape[0] - 1)
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Nodes:
    r"""Parameters and weights that turn a density of theta into one of the label.

    .. math:: p(y_i \mid x_i) \approx \frac1S \sum_s u_{is}\, q(\theta_{is} \mid x_i)

    Attributes:
        theta: Shape ``(n, S, d)``, in the dtype of the labels. All are inside the
            support of the prior, so that those with no weight do no harm to gradients.
        log_weights: :math:`\log u`, minus infinity outside the support of the prior,
            shape ``(n, S)``, float64.
    """

    theta: Tensor
    log_weights: Tensor

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: Tensor) -> "Nodes":
        return Nodes(theta=self.theta[rows], log_weights=self.log_weights[rows])

    def log_mean(self, log_q: Tensor) -> Tensor:
        r"""Return the log density of each label.

        Args:
            log_q: :math:`\log q(\theta_{is} \mid x_i)`, shape ``(n, S)`` or
                ``(n, S, K)`` for K posteriors.

        Returns:
            Shape ``(n,)`` or ``(n, K)``.
        """
        terms = self._terms(log_q)
        return terms.logsumexp(dim=1) - math.log(terms.shape[1])

    def standard_error(self, log_q: Tensor) -> Tensor:
        """Return the Monte-Carlo error of :meth:`log_mean`, to first order."""
        terms = self._terms(log_q)
        largest = terms.amax(dim=1, keepdim=True)
        ratio = (terms - largest.clamp_min(-1e300)).exp()
        mean = ratio.mean(dim=1).clamp_min(1e-300)
        return ratio.std(dim=1) / mean / terms.shape[1] ** 0.5

    def _terms(self, log_q: Tensor) -> Tensor:
        weights = self.log_weights
        if log_q.ndim == 3:
            weights = weights[..., None]
        # Where the weight is zero, the density may be anything.
        return torch.where(
            torch.isneginf(weights), weights, log_q.to(weights) + weights
        )


def place_nodes(
    labels: Labels, references: Sequence[Reference], prior: object, *, num_nodes: int
) -> Nodes:
    """Draw the nodes of labels that are measurements, from torch's random state.

    Args:
        labels: Labels that are not given as draws.
        references: Moments of the densities to be integrated, at the observation of
            each label. The nodes come from each of them in equal numbers.
        prior: The prior; nodes outside its support get the weight zero.
        num_nodes: The number of nodes of each label, at least.
    """
    n, d = labels.theta.shape
    of_each = max(1, math.ceil(num_nodes / len(references)))
    total = of_each * len(references)
    theta = labels.theta.double()[:, None].expand(n, total, d).clone()
    log_weights = labels.covariance.new_zeros(n, total)
    low, high = bounds_of(prior, log_weights.new_zeros(d))
    open_ones = ~labels.is_measured | labels.is_noisy
    for pattern in open_ones.unique(dim=0):
        if not pattern.any():
            continue
        rows = (open_ones == pattern).all(dim=1).nonzero().flatten()
        free = pattern.nonzero().flatten()
        for measured in labels.is_measured[rows].unique(dim=0):
            some = rows[(labels.is_measured[rows] == measured).all(dim=1)]
            drawn, log_density = _propose(
                labels[some],
                [reference[some] for reference in references],
                measured.nonzero().flatten(),
                free,
                of_each,
                bounds=(low[free], high[free]),
            )
            theta[some[:, None, None], torch.arange(total)[:, None], free] = drawn
            log_weights[some] = -log_density
    log_weights = log_weights + _log_likelihood(labels, theta)
    theta, inside = moved_inside(prior, theta.to(labels.theta).reshape(-1, d))
    return Nodes(
        theta=theta.reshape(n, total, d),
        log_weights=log_weights.where(inside.reshape(n, total), -torch.inf),
    )


def _propose(
    labels: Labels,
    references: Sequence[Reference],
    measured: Tensor,
    free: Tensor,
    of_each: int,
    *,
    bounds: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Draw the parameters that labels of one pattern leave open.

    Proposals are centred inside the bounds of these parameters.

    Returns:
        Draws of shape ``(n, S, f)`` and the log density of the mixture, ``(n, S)``.
    """
    low, high = bounds
    updated: list[tuple[Tensor, Tensor]] = []
    for reference in references:
        mean, factor = _updated(labels, reference, measured, free)
        updated.append((mean.maximum(low).minimum(high), factor))
    draws = torch.cat([_draw(*one, of_each) for one in updated], dim=1)
    log_density = torch.stack([_log_t(draws, *one) for one in updated])
    return draws, log_density.logsumexp(dim=0) - math.log(len(updated))


def _updated(
    labels: Labels, reference: Reference, measured: Tensor, free: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean and a Cholesky factor of the open parameters given the label."""
    mean, covariance = reference.mean, reference.covariance
    scale = covariance.diagonal(dim1=1, dim2=2).clamp_min(1e-300)
    covariance = covariance + JITTER * torch.diag_embed(scale)
    noise = labels.covariance[:, measured][:, :, measured]
    total = covariance[:, measured][:, :, measured] + noise
    cross = covariance[:, free][:, :, measured]
    gain = torch.linalg.solve(total, cross, left=False)
    surprise = labels.theta.double()[:, measured] - mean[:, measured]
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


def _draw(mean: Tensor, factor: Tensor, count: int) -> Tensor:
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


def _log_likelihood(labels: Labels, theta: Tensor) -> Tensor:
    r"""Return :math:`\log \mathcal N(y; \theta, R)` of the noisy parameters."""
    log_likelihood = theta.new_zeros(theta.shape[:2])
    for noisy in labels.is_noisy.unique(dim=0):
        if not noisy.any():
            continue
        rows = (labels.is_noisy == noisy).all(dim=1).nonzero().flatten()
        columns = noisy.nonzero().flatten()
        covariance = labels.covariance[rows][:, columns][:, :, columns]
        factor = torch.linalg.cholesky(covariance)
        y = labels.theta.double()[rows][:, columns]
        residual = (y[:, None] - theta[rows][..., columns]).mT
        squares = torch.linalg.solve_triangular(factor, residual, upper=False)
        log_likelihood[rows] = (
            -squares.square().sum(dim=1) / 2
            - factor.diagonal(dim1=1, dim2=2).log().sum(dim=1, keepdim=True)
            - len(columns) / 2 * math.log(2 * math.pi)
        )
    return log_likelihood
