r"""A Bayesian linear model of how real observations differ from simulations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from sbi_rope.data.pairs import groups_of
from sbi_rope.discrepancy.posterior import (
    Discrepancy,
    Regressions,
    independent_pairs,
    log_density_of_right,
    rounding,
)
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

# Ratios of the variance between groups to the one within them, and their prior. Those
# below .2 matter for large groups only.
VARIANCE_RATIOS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
PRIOR_OF_RATIOS = (1 / 30,) * 5 + (1 / 6,) * 5
# Chains that are run side by side. The imputations that are kept are so far apart that
# they are nearly independent for labels as noisy as the prior is wide.
NUM_CHAINS, NUM_WARM_UP, NUM_KEPT, APART = 10, 100, 2, 30
# Numbers in the largest tensor, unless one chain needs more.
MAX_ENTRIES = 2**22
# Draws of the discrepancy that an expected mean is averaged over.
NUM_DRAWS = 40


@dataclass(frozen=True, kw_only=True)
class DiscrepancyModel(Settings):
    r"""How real observations follow from simulations: a gain, an offset and an error.

    Let z be the representation of an observation, such as its embedding. With
    :math:`m_i` and C the mean and the covariance of simulations :math:`z_s` at the
    parameters of calibration pair i,

    .. math::
        z_o = A z_s + b + e, \quad e \sim \mathcal N(0, \Sigma')
        \qquad\Rightarrow\qquad
        z_i \mid \theta_i \sim \mathcal N(A m_i + b,\; \Sigma), \quad
        \Sigma = \Sigma' + A C A^\top .

    The prior is conjugate, and its centre is a simulator that is right,

    .. math::
        \Sigma \sim \mathrm{IW}\bigl((\nu - l - 1)\, s^2 V, \nu\bigr), \qquad
        (A, b) \mid \Sigma \sim \mathcal{MN}\bigl((I, 0), K^{-1}, \Sigma\bigr), \quad
        K = \operatorname{diag}(k + 4 l C_{11}, \ldots, k + 4 l C_{ll}, k / 3),

    so that posterior and evidence have closed forms. The shape V is I, or :math:`D^2`
    with the noise of simulations in each entry, relative to the largest: a precise
    entry may have a smaller error, too. V and the hyper-parameters k, s and
    :math:`\nu` are averaged over a grid, weighted by their evidence, so that there is
    nothing to choose.

    Recordings of one person or specimen can have errors in common. If these have the
    correlation :math:`\rho`, a group of k pairs counts as
    :math:`k / (1 + (k - 1)\, \rho)` independent ones (Kish's design effect), with the
    mean of :math:`\rho` over a grid, weighted by the evidence.

    The average contains the model :math:`z_i \mid \theta_i \sim \mathcal N(m_i, C)`, in
    which the simulator is right. If it is, the probability of this model goes to one
    with more pairs, and nothing is corrected. ``DiscrepancyNPE`` and stacks set
    the probability to zero if the pairs refute the simulator by themselves.

    All quantities are in standard deviations of simulations from the prior.

    References:
        | Bayesian Calibration of Computer Models (Kennedy and O'Hagan, 2001)
        | https://doi.org/10.1111/1467-9868.00294
        | Survey Sampling (Kish, 1965), section 5.4, of the design effect

    Args:
        gain_precisions: Values of k.
        error_scales: Values of s.
        degrees_of_freedom: Values of :math:`\nu - l - 1`. The prior of the error counts
            as much as this number of pairs.
        probability_of_none: The prior probability that the simulator is right.

    Example:
        >>> z_s = torch.linspace(-1.0, 1.0, 20)[:, None]
        >>> found = DiscrepancyModel().fit(0.5 * z_s + 2.0, z_s, torch.tensor([[0.01]]))
        >>> gain, offset, _ = found.sample(1000, seed=0)
        >>> round(float(gain.mean()), 1), round(float(offset.mean()), 1)
        (0.5, 2.0)
    """

    gain_precisions: Sequence[float] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 1000.0)
    error_scales: Sequence[float] = (0.01, 0.03, 0.05, 0.1, 0.2, 0.4, 0.8)
    degrees_of_freedom: Sequence[float] = (1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
    probability_of_none: UnitInterval = 0.5

    def fit(
        self,
        z: Tensor,
        mean: Tensor,
        covariance: Tensor,
        *,
        weights: Tensor | None = None,
        groups: Tensor | None = None,
    ) -> Discrepancy:
        r"""Return the posterior of the discrepancy given calibration pairs, in float64.

        If parameters are not known exactly, ``mean`` holds the means at R parameters
        that are equally probable before the observation is seen. Ten chains of a Gibbs
        sampler then impute the parameters and draw the discrepancy in turn (data
        augmentation). The posterior is the average over two imputations of each chain.

        References:
            | The Calculation of Posterior Distributions by Data Augmentation (Tanner
              and Wong, 1987)
            | https://doi.org/10.1080/01621459.1987.10478458

        Args:
            z: Representations of the real observations, shape ``(n, l)``.
            mean: :math:`m_i`, the mean of simulations at the parameters of each
                observation, shape ``(n, l)``, or its possible values, ``(n, R, l)``.
            covariance: C, the covariance of simulations at one parameter, averaged over
                the pairs, shape ``(l, l)``.
            weights: How many pairs each pair counts as, shape ``(n,)``; one if None.
            groups: A number for each pair, shape ``(n,)``. Pairs with the same number,
                such as recordings of one person, can have errors in common, and count
                as fewer. None if all are independent.
        """
        width, possible = np.shape(z)[-1:], np.shape(mean)[1:-1][:1]
        z = as_batch("z", z, width).double()
        mean = as_batch("mean", mean, (*possible, *width), rows=len(z)).to(z)
        covariance = as_batch("covariance", covariance, width, rows=width[0]).to(z)
        noise = covariance + rounding(covariance).diag()
        weights = torch.ones(len(z)) if weights is None else weights
        weights = as_batch("weights", weights, (), rows=len(z)).to(z)
        if groups is not None:
            groups = groups_of(as_batch("groups", groups, (), rows=len(z))).to(z.device)
            groups = None if len(groups.unique()) == len(z) else groups
        once = weights if groups is None else independent_pairs(groups, 1.0, weights)
        precisions = z.new_tensor(self.gain_precisions)
        grids = z.new_tensor(self.error_scales), z.new_tensor(self.degrees_of_freedom)
        settings = torch.cartesian_prod(*grids)
        regress = partial(Regressions.of, z, noise=noise, settings=settings)

        def counts(mean: Tensor) -> Tensor:
            """Return how many independent pairs each counts as, for B sets of means."""
            if groups is None:
                return weights
            ratios, ones = torch.tensor(VARIANCE_RATIOS).to(z), torch.ones_like(weights)
            correlations = ratios / (1 + ratios)
            evidence = [
                # Half of the precisions are enough to compare correlations.
                regress(
                    mean, ones, precisions[::2], groups=groups, correlation=one
                ).log_evidence.logsumexp(dim=(1, 2))
                for one in correlations.tolist()
            ]
            log_prior = torch.tensor(PRIOR_OF_RATIOS).to(z).log()
            shares = (torch.stack(evidence, dim=1) + log_prior).softmax(dim=1)
            return independent_pairs(groups, shares @ correlations, weights)

        def posterior(mean: Tensor, weights: Tensor) -> tuple[Regressions, Tensor]:
            """Return regressions, and the probability that the simulator is right."""
            found = judged = regress(mean, weights, precisions)
            if groups is not None:
                # Whether the simulator is right is judged with each group as one pair.
                # With a correlation that is too low, a right one would be refuted.
                judged = regress(mean, once, precisions)
            right = log_density_of_right(z - mean, noise, once)
            prior = torch.logit(right.new_tensor(self.probability_of_none))
            return found, torch.sigmoid(right - judged.mean_log_evidence() + prior)

        if possible and possible != (1,):
            with seeded(0):
                return impute(z, mean, posterior, counts)
        mean = mean.reshape(1, *z.shape)
        found, none = posterior(mean, counts(mean))
        return found.posteriors(none)[0]


def impute(
    z: Tensor,
    possible: Tensor,
    posterior: Callable[[Tensor, Tensor], tuple[Regressions, Tensor]],
    counts: Callable[[Tensor], Tensor],
) -> Discrepancy:
    r"""Average the posterior over imputed means, by Gibbs sampling in C chains.

    We draw one of the possible means :math:`m_{ir}` of each observation, ``(n, R, l)``,
    with probabilities :math:`p_{ir} \propto \mathcal N(z_i; A m_{ir} + b, \Sigma)`, and
    then A, b and :math:`\Sigma` from their posterior given these means, ``(C, n, l)``,
    and given how many pairs each counts as, ``(n,)`` or ``(C, n)``.
    """
    mean = possible.mean(dim=1).expand(NUM_CHAINS, -1, -1)
    weights = counts(mean)
    found, none = posterior(mean, weights)
    kept: list[Discrepancy] = []
    for number in range(1, NUM_WARM_UP + NUM_KEPT * APART + 1):
        probabilities = _probabilities(z, possible, *found.draw(none))
        # Faster than torch.multinomial, which draws a number for each of the means.
        bounds = probabilities.cumsum(dim=-1)
        drawn = torch.rand(bounds.shape[:-1]).to(bounds) * bounds[..., -1]
        chosen = torch.searchsorted(bounds, drawn[..., None], right=True)[..., 0]
        mean = possible[torch.arange(len(z)), chosen.clamp_max(possible.shape[1] - 1)]
        if number == NUM_WARM_UP:
            weights = counts(mean)
        found, none = posterior(mean, weights)
        if number > NUM_WARM_UP and (number - NUM_WARM_UP) % APART == 0:
            kept.extend(found.posteriors(none))
    # They are not zero, even if the simulator is right in all of them.
    off = [max(1 - one.probability_of_none, 1e-290) for one in kept]
    shares = torch.cat([p * one.shares for p, one in zip(off, kept, strict=True)])
    names = "probability_of_none", "log_evidence"
    return replace(
        kept[0],
        terms=tuple(term for one in kept for term in one.terms),
        shares=shares / shares.sum(),
        **{name: fmean(getattr(one, name) for one in kept) for name in names},
    )


def expected_means(discrepancy: Discrepancy, z: Tensor, possible: Tensor) -> Tensor:
    r"""Return the posterior mean of :math:`\sum_r p_{ir}\, m_{ir}`, ``(n, l)``."""
    noise = discrepancy.noise
    right = torch.eye(len(noise)).to(noise), noise.new_zeros(len(noise)), noise
    drawn = []
    for _ in range(NUM_DRAWS):
        if float(torch.rand(())) < discrepancy.probability_of_none:
            drawn.append(right)
            continue
        chosen = int(torch.multinomial(discrepancy.shares, 1))
        drawn.append([one[0] for one in discrepancy.terms[chosen].sample(1)])
    gain, offset, covariance = map(torch.stack, zip(*drawn, strict=True))
    probabilities = _probabilities(z, possible, gain, offset, covariance).mean(dim=0)
    return (probabilities[..., None] * possible).sum(dim=1)


def _probabilities(
    z: Tensor, possible: Tensor, gain: Tensor, offset: Tensor, covariance: Tensor
) -> Tensor:
    """Return the probability of each possible mean given z, shape ``(C, n, R)``."""
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
        )
        for seen, to_seen in parts
    ]
    return torch.softmax(-torch.cat(distances)[:, :, 0].square() / 2, dim=-1)
