"""The posterior of the discrepancy at each setting of the hyper-parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.discrepancy.regression import SMALLEST_NOISE, Regressions

__all__ = ["Conditional"]

# Settings of the hyper-parameters are left out if their evidence is less than this
# share of the evidence of the best setting.
NEGLIGIBLE = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditional:
    """The posterior of the discrepancy given one mean of each observation.

    Attributes:
        regressions: The posterior at K precisions of the gain.
        log_evidence: Its log evidence at these and S further settings, shape
            ``(K, S)``.
        settings: The error scales and strengths, S of each.
        noise: The covariance C of simulations at one parameter, shape ``(l, l)``.
        average: Log density of the pairs under a discrepancy, with each group as one
            pair.
        right: The same if the simulator is right.
        probability_of_none: The probability that the simulator is right.
        num_pairs: The number of calibration pairs.
    """

    regressions: Regressions
    log_evidence: Tensor
    settings: Sequence[tuple[float, float]]
    noise: Tensor
    average: float
    right: float
    probability_of_none: float
    num_pairs: int

    @classmethod
    def of(
        cls,
        z: Tensor,
        mean: Tensor,
        noise: Tensor,
        *,
        gain_precisions: Sequence[float],
        settings: Sequence[tuple[float, float]],
        prior_of_none: float,
        weights: Tensor | None,
        once: Tensor | None,
    ) -> "Conditional":
        """Return the posterior given the mean of each observation.

        Args:
            z: Representations of the real observations, shape ``(n, l)``.
            mean: The means of simulations at their parameters, shape ``(n, l)``.
            noise: C, with no eigenvalue of zero.
            gain_precisions: Values of k.
            settings: Values of s, each with one of the strength.
            prior_of_none: The prior probability that the simulator is right.
            weights: How many pairs each pair counts as, shape ``(n,)``; one if None.
            once: The same if each group counts as one pair, by which it is judged
                whether the simulator is right.
        """
        regressions = Regressions.of(z, mean, gain_precisions, weights=weights)
        log_evidence = regressions.log_evidence(settings)
        judged = log_evidence
        if once is not weights:
            as_one_pair = Regressions.of(z, mean, gain_precisions, weights=once)
            judged = as_one_pair.log_evidence(settings)
        average = judged.logsumexp(dim=(0, 1)) - math.log(judged.numel())
        right = _log_evidence_of_none(z - mean, noise, once)
        return cls(
            regressions=regressions,
            log_evidence=log_evidence,
            settings=settings,
            noise=noise,
            average=float(average),
            right=float(right),
            probability_of_none=_posterior_probability(prior_of_none, right - average),
            num_pairs=len(z),
        )

    def posterior(self) -> Discrepancy:
        """Return the average over the settings whose evidence is not negligible."""
        evidence = self.log_evidence
        kept = evidence > evidence.max() + math.log(NEGLIGIBLE)
        return Discrepancy(
            terms=tuple(
                self.regressions.at(k, *self.settings[s])
                for k, s in kept.nonzero().tolist()
            ),
            shares=torch.softmax(evidence[kept], dim=0),
            noise=self.noise,
            probability_of_none=self.probability_of_none,
            log_evidence=self.average,
            log_evidence_of_none=self.right,
            num_pairs=self.num_pairs,
            num_independent=self.regressions.num_pairs,
        )

    def draw(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a gain, an offset and the covariance of observations at one parameter.

        They are drawn from :meth:`posterior`, without computing it, and with the
        settings that it leaves out. Random numbers come from torch's random state.
        """
        if float(torch.rand(())) < self.probability_of_none:
            width = len(self.noise)
            identity = torch.eye(width).to(self.noise)
            return identity, self.noise.new_zeros(width), self.noise
        probabilities = torch.softmax(self.log_evidence.flatten(), dim=0)
        k, s = divmod(int(torch.multinomial(probabilities, 1)), len(self.settings))
        drawn = self.regressions.at(k, *self.settings[s]).sample(1)
        gain, offset, covariance = (values[0] for values in drawn)
        return gain, offset, covariance


def _log_evidence_of_none(
    residual: Tensor, noise: Tensor, weights: Tensor | None
) -> Tensor:
    """Return the log density of z - m, rounded as ``Regressions`` assumes."""
    log_density = MultivariateNormal(torch.zeros_like(residual[0]), noise).log_prob
    n = len(residual) if weights is None else weights.sum()
    inexact = n * SMALLEST_NOISE**2 * torch.linalg.inv(noise).trace()
    log_densities = log_density(residual)
    if weights is not None:
        log_densities = weights * log_densities
    return log_densities.sum() - inexact / 2


def _posterior_probability(prior: float, log_bayes_factor: Tensor) -> float:
    if prior in (0.0, 1.0):
        return prior
    return float(torch.sigmoid(log_bayes_factor + math.log(prior / (1.0 - prior))))
