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
    """The posterior of the discrepancy given the mean of each observation.

    There are B sets of means, each of which has a posterior of its own.

    Attributes:
        regressions: The posteriors at K precisions of the gain.
        log_evidence: Their log evidence at these and S further settings, shape
            ``(B, K, S)``.
        settings: The error scales and strengths, S of each.
        noise: The covariance C of simulations at one parameter, shape ``(l, l)``.
        average: Log density of the pairs under a discrepancy, with each group as one
            pair, shape ``(B,)``.
        right: The same if the simulator is right, shape ``(B,)``.
        probability_of_none: The probability that the simulator is right, ``(B,)``.
        num_pairs: The number of calibration pairs.
    """

    regressions: Regressions
    log_evidence: Tensor
    settings: Sequence[tuple[float, float]]
    noise: Tensor
    average: Tensor
    right: Tensor
    probability_of_none: Tensor
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
        """Return the posteriors given B sets of means.

        Args:
            z: Representations of the real observations, shape ``(n, l)``.
            mean: The means of simulations at their parameters, shape ``(B, n, l)``.
            noise: C, with no eigenvalue of zero.
            gain_precisions: Values of k.
            settings: Values of s, each with one of the strength.
            prior_of_none: The prior probability that the simulator is right.
            weights: How many pairs each pair counts as, shape ``(n,)`` or ``(B, n)``;
                one if None.
            once: The same if each group counts as one pair, by which it is judged
                whether the simulator is right, shape ``(n,)``.
        """
        regressions = Regressions.of(z, mean, gain_precisions, weights=weights)
        log_evidence = regressions.log_evidence(settings)
        judged = log_evidence
        if once is not weights:
            as_one_pair = Regressions.of(z, mean, gain_precisions, weights=once)
            judged = as_one_pair.log_evidence(settings)
        average = judged.logsumexp(dim=(1, 2)) - math.log(judged[0].numel())
        right = _log_evidence_of_none(z - mean, noise, once)
        return cls(
            regressions=regressions,
            log_evidence=log_evidence,
            settings=settings,
            noise=noise,
            average=average,
            right=right,
            probability_of_none=_posterior_probability(prior_of_none, right - average),
            num_pairs=len(z),
        )

    def posteriors(self) -> list[Discrepancy]:
        """Return the averages over the settings whose evidence is not negligible."""
        return [self._posterior(number) for number in range(len(self.log_evidence))]

    def _posterior(self, number: int) -> Discrepancy:
        evidence = self.log_evidence[number]
        kept = evidence > evidence.max() + math.log(NEGLIGIBLE)
        return Discrepancy(
            terms=tuple(
                self.regressions.at((number, k), *self.settings[s])
                for k, s in kept.nonzero().tolist()
            ),
            shares=torch.softmax(evidence[kept], dim=0),
            noise=self.noise,
            probability_of_none=float(self.probability_of_none[number]),
            log_evidence=float(self.average[number]),
            log_evidence_of_none=float(self.right[number]),
            num_pairs=self.num_pairs,
            num_independent=float(self.regressions.num_pairs[number]),
        )

    def draw(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a gain, an offset and the covariance of observations at one parameter.

        One of each is drawn from each of :meth:`posteriors`, without computing them,
        and with the settings that they leave out. Random numbers come from torch's
        random state.

        Returns:
            Tensors of shapes ``(B, l, l)``, ``(B, l)`` and ``(B, l, l)``.
        """
        probabilities = torch.softmax(self.log_evidence.flatten(1), dim=1)
        chosen = torch.multinomial(probabilities, 1)[:, 0]
        k, s = chosen // len(self.settings), chosen % len(self.settings)
        scale, strength = self.noise.new_tensor(self.settings)[s].unbind(dim=1)
        which = torch.arange(len(chosen), device=chosen.device)
        drawn = self.regressions.at((which, k), scale, strength).sample(1)
        gain, offset, covariance = (values[0] for values in drawn)
        none = torch.rand(len(chosen)).to(gain) < self.probability_of_none
        identity = torch.eye(len(self.noise)).to(gain)
        return (
            torch.where(none[:, None, None], identity, gain),
            offset.masked_fill(none[:, None], 0.0),
            torch.where(none[:, None, None], self.noise, covariance),
        )


def _log_evidence_of_none(
    residual: Tensor, noise: Tensor, weights: Tensor | None
) -> Tensor:
    """Return the log density of z - m, ``(B,)``, rounded as ``Regressions`` do."""
    log_density = MultivariateNormal(torch.zeros_like(noise[0]), noise).log_prob
    n = residual.shape[1] if weights is None else weights.sum()
    inexact = n * SMALLEST_NOISE**2 * torch.linalg.inv(noise).trace()
    log_densities = log_density(residual)
    if weights is not None:
        log_densities = weights * log_densities
    return log_densities.sum(dim=1) - inexact / 2


def _posterior_probability(prior: float, log_bayes_factor: Tensor) -> Tensor:
    return torch.sigmoid(
        log_bayes_factor + torch.logit(log_bayes_factor.new_tensor(prior))
    )
