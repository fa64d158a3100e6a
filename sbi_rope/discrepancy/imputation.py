"""The discrepancy of pairs whose parameters are not known exactly."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope.discrepancy.conditional import Conditional
from sbi_rope.discrepancy.posterior import Discrepancy

__all__ = ["expected_means", "impute"]

# Imputations that are left out, because they depend on where they started, and those
# that the posterior is averaged over. So many later imputations belong to each of them.
# If labels are as noisy as the prior is wide, imputations that far apart are nearly
# independent.
NUM_WARM_UP, NUM_KEPT, APART = 100, 20, 30
# Draws of the discrepancy that an expected mean is averaged over.
NUM_DRAWS = 40


def impute(
    z: Tensor,
    possible: Tensor,
    conditional: Callable[[Tensor, Tensor | None], Conditional],
    counts: Callable[[Tensor], Tensor | None],
) -> Discrepancy:
    r"""Average the posterior over imputed parameters, by Gibbs sampling.

    Given a gain, an offset and an error, the possible means :math:`m_{ir}` of an
    observation have the probabilities

    .. math:: p_{ir} \propto \mathcal N(z_i; A m_{ir} + b, \Sigma).

    One of them is drawn for each observation. Given these means the posterior of the
    discrepancy has a closed form, of which the next gain, offset and error are drawn.
    Random numbers come from torch's random state.

    Args:
        z: Representations of the real observations, shape ``(n, l)``.
        possible: :math:`m_{ir}`, shape ``(n, R, l)``, equally probable before.
        conditional: Returns the posterior given one mean of each observation,
            ``(n, l)``, and how many pairs each of them counts as.
        counts: Returns how many pairs each counts as, ``(n,)``, given these means. It
            is asked at the start, and again for the imputations that are kept.

    Returns:
        The posterior. Its two evidences, ``probability_of_none`` and
        ``num_independent`` are averages over the imputations.
    """
    mean = possible.mean(dim=1)
    weights = counts(mean)
    given = conditional(mean, weights)
    kept: list[Discrepancy] = []
    for number in range(1, NUM_WARM_UP + NUM_KEPT * APART + 1):
        mean = _imputed(z, possible, *given.draw())
        if number == NUM_WARM_UP:
            weights = counts(mean)
        given = conditional(mean, weights)
        if number > NUM_WARM_UP and (number - NUM_WARM_UP) % APART == 0:
            kept.append(given.posterior())
    shares = torch.cat([(1 - one.probability_of_none) * one.shares for one in kept])
    total = shares.sum()
    if not total > 0:  # the simulator is right in all of them
        shares, total = torch.cat([one.shares for one in kept]), float(NUM_KEPT)
    return Discrepancy(
        terms=tuple(term for one in kept for term in one.terms),
        shares=shares / total,
        noise=given.noise,
        probability_of_none=_mean([one.probability_of_none for one in kept]),
        log_evidence=_mean([one.log_evidence for one in kept]),
        log_evidence_of_none=_mean([one.log_evidence_of_none for one in kept]),
        num_pairs=len(z),
        num_independent=_mean([one.num_independent for one in kept]),
    )


def expected_means(discrepancy: Discrepancy, z: Tensor, possible: Tensor) -> Tensor:
    r"""Return the means of observations that are expected given them.

    This is :math:`\sum_r p_{ir}\, m_{ir}` with the probabilities of :func:`impute`,
    averaged over the posterior of the discrepancy. Random numbers come from torch's
    random state.

    Args:
        discrepancy: The posterior.
        z: Representations of the real observations, shape ``(n, l)``.
        possible: :math:`m_{ir}`, shape ``(n, R, l)``, equally probable before.

    Returns:
        Shape ``(n, l)``.
    """
    probabilities = torch.zeros(possible.shape[:2]).to(possible)
    for _ in range(NUM_DRAWS):
        drawn = _drawn(discrepancy, discrepancy.noise)
        probabilities += _probabilities(z, possible, *drawn) / NUM_DRAWS
    return (probabilities[..., None] * possible).sum(dim=1)


def _drawn(discrepancy: Discrepancy, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a gain, an offset and the covariance of observations at one parameter."""
    width = len(noise)
    if float(torch.rand(())) < discrepancy.probability_of_none:
        return torch.eye(width).to(noise), noise.new_zeros(width), noise
    chosen = int(torch.multinomial(discrepancy.shares, 1))
    gain, offset, covariance = discrepancy.terms[chosen].sample(1)
    return gain[0], offset[0], covariance[0]


def _imputed(
    z: Tensor, possible: Tensor, gain: Tensor, offset: Tensor, covariance: Tensor
) -> Tensor:
    """Draw one of the possible means of each observation, shape ``(n, l)``."""
    probabilities = _probabilities(z, possible, gain, offset, covariance)
    chosen = torch.multinomial(probabilities, 1)
    return possible[torch.arange(len(z)), chosen[:, 0]]


def _probabilities(
    z: Tensor, possible: Tensor, gain: Tensor, offset: Tensor, covariance: Tensor
) -> Tensor:
    """Return the probability of each possible mean given z, shape ``(n, R)``."""
    residual = z[:, None] - possible @ gain.mT - offset
    normal = MultivariateNormal(torch.zeros_like(offset), covariance)
    return torch.softmax(normal.log_prob(residual), dim=1)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
