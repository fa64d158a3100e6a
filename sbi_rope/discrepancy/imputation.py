"""The discrepancy of pairs whose parameters are not known exactly."""

from collections.abc import Callable

import torch
from torch import Tensor

from sbi_rope.discrepancy.conditional import Conditional
from sbi_rope.discrepancy.posterior import Discrepancy

__all__ = ["expected_means", "impute"]

# Chains that are run side by side, which costs hardly more than one of them.
NUM_CHAINS = 10
# Imputations of a chain that are left out, because they depend on where it started, and
# those that the posterior is averaged over. So many later imputations belong to each of
# them. If labels are as noisy as the prior is wide, imputations that far apart are
# nearly independent.
NUM_WARM_UP, NUM_KEPT, APART = 100, 2, 30
# Numbers in the largest tensor, unless one chain needs more.
MAX_ENTRIES = 2**22
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
    C chains of such draws are independent of each other. Random numbers come from
    torch's random state.

    Args:
        z: Representations of the real observations, shape ``(n, l)``.
        possible: :math:`m_{ir}`, shape ``(n, R, l)``, equally probable before.
        conditional: Returns the posteriors given C sets of means, ``(C, n, l)``, and
            how many pairs each of them counts as.
        counts: Returns how many pairs each counts as, ``(n,)`` or ``(C, n)``, given
            these means. It is asked at the start, and again for the imputations that
            are kept.

    Returns:
        The posterior. Its two evidences, ``probability_of_none`` and
        ``num_independent`` are averages over the imputations.
    """
    mean = possible.mean(dim=1).expand(NUM_CHAINS, -1, -1)
    weights = counts(mean)
    given = conditional(mean, weights)
    kept: list[Discrepancy] = []
    for number in range(1, NUM_WARM_UP + NUM_KEPT * APART + 1):
        mean = _imputed(z, possible, *given.draw())
        if number == NUM_WARM_UP:
            weights = counts(mean)
        given = conditional(mean, weights)
        if number > NUM_WARM_UP and (number - NUM_WARM_UP) % APART == 0:
            kept.extend(given.posteriors())
    shares = torch.cat([(1 - one.probability_of_none) * one.shares for one in kept])
    total = shares.sum()
    if not total > 0:  # the simulator is right in all of them
        shares, total = torch.cat([one.shares for one in kept]), float(len(kept))
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
    drawn = [_drawn(discrepancy, discrepancy.noise) for _ in range(NUM_DRAWS)]
    gain, offset, covariance = map(torch.stack, zip(*drawn, strict=True))
    probabilities = _probabilities(z, possible, gain, offset, covariance).mean(dim=0)
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
    """Draw one of the possible means of each observation, shape ``(C, n, l)``."""
    probabilities = _probabilities(z, possible, gain, offset, covariance)
    # Faster than torch.multinomial, which draws a number for each of the means.
    bounds = probabilities.cumsum(dim=-1)
    drawn = torch.rand(bounds.shape[:-1]).to(bounds) * bounds[..., -1]
    chosen = torch.searchsorted(bounds, drawn[..., None], right=True)[..., 0]
    return possible[torch.arange(len(z)), chosen.clamp_max(possible.shape[1] - 1)]


def _probabilities(
    z: Tensor, possible: Tensor, gain: Tensor, offset: Tensor, covariance: Tensor
) -> Tensor:
    """Return the probability of each possible mean given z, shape ``(C, n, R)``.

    Args:
        z: Representations of the real observations, shape ``(n, l)``.
        possible: Their possible means, shape ``(n, R, l)``.
        gain: C gains, shape ``(C, l, l)``.
        offset: Offsets, shape ``(C, l)``.
        covariance: Covariances of observations at one parameter, ``(C, l, l)``.
    """
    # Observations and means are mapped to where their differences are standard normal.
    identity = torch.eye(z.shape[1]).to(z).expand_as(covariance)
    factor = torch.linalg.cholesky(covariance)
    whiten = torch.linalg.solve_triangular(factor, identity, upper=False)
    observed = (z - offset[:, None]) @ whiten.mT
    flat = possible.flatten(0, 1)
    chunk = max(1, MAX_ENTRIES // possible.numel())
    parts = zip(observed.split(chunk), (whiten @ gain).split(chunk), strict=True)
    distances = [
        torch.cdist(
            seen[:, :, None],
            (flat @ to_seen.mT).unflatten(1, possible.shape[:2]),
            compute_mode="donot_use_mm_for_euclid_dist",
        )[:, :, 0]
        for seen, to_seen in parts
    ]
    return torch.softmax(-torch.cat(distances).square() / 2, dim=-1)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
