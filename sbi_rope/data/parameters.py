r"""The distribution of parameters, learned from those of the calibration pairs."""

import math
from statistics import fmean
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from sbi_rope.data.labels import log_student_t
from sbi_rope.data.pairs import Pairs
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.tensors import as_batch

# Draws of the prior that the parameters of pairs are compared with, and draws of each
# label that is not exact.
NUM_FROM_PRIOR, NUM_SETS = 10_000, 10
# The prior's mean and covariance count as much as one of these numbers of pairs.
STRENGTHS = (2.0, 5.0, 10.0, 30.0, 100.0)
# Parameters of pairs are said not to follow the prior if this is less probable. By
# Markov's inequality, at most one in 19 sets of pairs from the prior gets there.
IMPROBABLE = 0.05
# Scores of labels, which may be rounded to a bound, are cut off where one of so many
# sets of pairs from the prior has a score.
SETS_CUT_OFF = 20
# Normal scores of a parameter with a more frequent value are not normal.
MAX_SHARE = 0.05


class ParameterDistribution(NamedTuple):
    """The probability of each simulation, ``(n,)``, and that of the prior.

    With these, simulations from the prior follow the real parameters. If all parameters
    are discrete, the probability that the real ones follow the prior is 0.5.
    """

    probabilities: Tensor
    probability_of_prior: float


def learn_parameters(
    theta_cal: Tensor, theta: Tensor, *, weights: Tensor | None = None
) -> ParameterDistribution:
    r"""Weight simulations so that their parameters are distributed like those of pairs.

    Each parameter is replaced by its normal score u under the prior, with correlation
    R. With equal weight before any pair is seen, real parameters follow the prior, or

    .. math::
        u \sim \mathcal N(\mu, \Lambda), \quad
        \Lambda \sim \mathrm{IW}(c\, R, c + d + 1), \quad
        \mu \mid \Lambda \sim \mathcal N(0, \Lambda / c),

    averaged over values of c by their evidence. With :math:`\pi` the probability of the
    prior afterwards and t(u) the predictive density, simulations are drawn with
    probabilities proportional to :math:`\pi + (1 - \pi)\, t(u) / \mathcal N(u; 0, R)`.

    Discrete parameters, of which more than one in twenty simulations share a value,
    stay distributed as in the prior, given the others.

    Args:
        theta_cal: Parameters of the pairs, ``(n_c, d)``, or R draws of each label,
            ``(n_c, R, d)``, over which the probabilities are averaged. Equal ones are
            one draw from the distribution.
        theta: Parameters of at least two simulations from the prior, ``(n, d)``.
        weights: How many draws each pair counts as, ``(n_c,)``; those of equal
            parameters are added. If None, equal parameters count once.
    """
    theta = as_batch("theta", theta, np.shape(theta)[-1:])
    several = np.shape(theta_cal)[1:-1][:1]
    theta_cal = as_batch("theta_cal", theta_cal, (*several, theta.shape[1]))
    if weights is not None:
        weights = as_batch("weights", weights, (), rows=len(theta_cal))
        weights = weights.to(theta_cal.device, torch.double)
    most = torch.stack([one.unique(return_counts=True)[1].max() for one in theta.T])
    is_continuous = most <= max(1.0, MAX_SHARE * len(theta))
    uniform = theta.new_full((len(theta),), 1.0 / len(theta), dtype=torch.double)
    if not is_continuous.any():
        return ParameterDistribution(uniform, 0.5)
    sets = theta_cal.unbind(dim=1)[:NUM_SETS] if theta_cal.ndim == 3 else [theta_cal]
    parts = [_learn(draws, theta, weights, is_continuous) for draws in sets]
    mixed = [p * uniform + (1.0 - p) * ratio for p, ratio in parts]
    of_prior = fmean(p for p, _ in parts)
    return ParameterDistribution(torch.stack(mixed).mean(dim=0), of_prior)


def probability_of_prior(pairs: Pairs, prior: Distribution, *, seed: int = 0) -> float:
    """Return the probability that the parameters of pairs follow the prior."""
    with seeded(seed):
        theta = prior.sample(torch.Size((NUM_FROM_PRIOR,)))
    theta, weights = theta.to(pairs.theta), pairs.shared_weight
    return learn_parameters(pairs.theta, theta, weights=weights).probability_of_prior


def is_improbable(probability_of_prior: float | None) -> bool:
    """Tell whether the parameters of pairs are hardly draws from the prior."""
    return probability_of_prior is not None and probability_of_prior < IMPROBABLE


def _learn(
    theta_cal: Tensor, theta: Tensor, weights: Tensor | None, is_continuous: Tensor
) -> tuple[float, Tensor]:
    """Return the probability of the prior, and those of simulations without it."""
    # People who differ in a discrete parameter only are different people.
    theta_cal, place = theta_cal.unique(dim=0, return_inverse=True)
    counts = torch.ones(len(theta_cal), dtype=torch.double, device=theta_cal.device)
    if weights is not None:
        counts = torch.zeros_like(counts).index_add(0, place, weights)
    theta_cal, theta = theta_cal[:, is_continuous], theta[:, is_continuous]
    u_cal, u = normal_scores(theta_cal, theta), normal_scores(theta, theta)
    end = -torch.special.ndtri(1.0 / (SETS_CUT_OFF * counts.sum().clamp(min=1.0)))
    u_cal = u_cal.clamp(-end, end)
    correlation = torch.atleast_2d(u.T.cov())
    # The small number keeps R positive definite if a parameter is a function of others.
    correlation = correlation + 1e-6 * torch.eye(len(correlation)).to(u)
    normal = MultivariateNormal(torch.zeros_like(u[0]), correlation)
    fits = [_fit(u_cal, u, counts, correlation, strength) for strength in STRENGTHS]
    evidence, log_t = (torch.stack(parts, dim=-1) for parts in zip(*fits, strict=True))
    average = evidence.logsumexp(dim=0) - math.log(len(fits))
    probability = float(torch.sigmoid(counts @ normal.log_prob(u_cal) - average))
    log_t = (log_t + evidence.log_softmax(dim=0)).logsumexp(dim=1)
    return probability, torch.softmax(log_t - normal.log_prob(u), dim=0)


def normal_scores(theta: Tensor, reference: Tensor) -> Tensor:
    """Map parameters ``(m, d)`` to normal quantiles of their ranks among a reference.

    Equal values get the middle of their ranks.
    """
    ordered = reference.double().T.contiguous().sort(dim=1).values
    values = theta.double().T.contiguous()
    below = torch.searchsorted(ordered, values)
    upto = torch.searchsorted(ordered, values, right=True)
    rank = (below + upto).double() / 2 + 0.5
    return torch.special.ndtri(rank / (ordered.shape[1] + 1)).T


def _fit(
    u_cal: Tensor, u: Tensor, counts: Tensor, correlation: Tensor, strength: float
) -> tuple[Tensor, Tensor]:
    """Return the log evidence of a value of c, and the log predictive density at u."""
    n, d = float(counts.sum()), u_cal.shape[1]
    degrees, scale = strength + d + 1, strength * correlation
    average = counts @ u_cal / n
    centred = u_cal - average
    total = strength + n
    new_degrees = degrees + n
    new_scale = scale + centred.T @ (counts[:, None] * centred)
    new_scale = new_scale + strength * n / total * torch.outer(average, average)
    log_evidence = (
        -n * d / 2 * math.log(math.pi)
        + torch.special.multigammaln(u.new_tensor(new_degrees / 2), d)
        - torch.special.multigammaln(u.new_tensor(degrees / 2), d)
        + degrees / 2 * torch.logdet(scale)
        - new_degrees / 2 * torch.logdet(new_scale)
        + d / 2 * math.log(strength / total)
    )
    freedom = new_degrees - d + 1
    factor = torch.linalg.cholesky(new_scale * (total + 1) / (total * freedom))
    return log_evidence, log_student_t(u, n / total * average, factor, freedom)
