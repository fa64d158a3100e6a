r"""A Bayesian linear model of how real observations differ from simulations."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.data import groups_of
from sbi_rope.discrepancy.conditional import Conditional
from sbi_rope.discrepancy.correlation import GroupErrors, independent_pairs
from sbi_rope.discrepancy.imputation import impute
from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.discrepancy.regression import SMALLEST_NOISE, Regressions
from sbi_rope.settings import Settings, UnitInterval
from sbi_rope.tensors import as_batch

__all__ = ["DiscrepancyModel"]

# How many times as large the variance between the groups is as the one within them, and
# their prior probabilities. Those below .2 matter for large groups only. Together they
# are as probable as one of the others.
VARIANCE_RATIOS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
PRIOR_OF_RATIOS = (1 / 30,) * 5 + (1 / 6,) * 5


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
        \Sigma \sim \mathrm{IW}\bigl((\nu - l - 1)\, s^2 I, \nu\bigr), \qquad
        (A, b) \mid \Sigma \sim \mathcal{MN}\bigl((I, 0), K^{-1}, \Sigma\bigr), \quad
        K = \operatorname{diag}(k, \ldots, k, k / 3),

    so that the posterior has the same form and the evidence has a closed form. The
    hyper-parameters k, s and :math:`\nu` are averaged over a grid, weighted by their
    evidence, so that there is nothing to choose.

    Recordings of one person or specimen can have errors in common. If these have the
    correlation :math:`\rho`, a group of k pairs counts as

    .. math:: \frac{k}{1 + (k - 1)\, \rho}

    independent ones (Kish's design effect). For :math:`\rho` its mean over a grid is
    taken, weighted by the evidence of matrix normal errors with this correlation. The
    covariance of the errors is still that of all pairs, because a person can be unusual
    in some entries of z only. Whether the simulator is right is judged with each group
    as one pair.

    The average contains the model :math:`z_i \mid \theta_i \sim \mathcal N(m_i, C)`, in
    which the simulator is right. Before any pair is seen its probability is
    ``probability_of_none``. If the simulator is right, the probability goes to one with
    more pairs, and nothing is corrected. An exception are simulators whose noise varies
    by a factor of several with the parameters, because C is the same for all pairs. If
    the pairs by themselves refute that the simulator is right, :class:`DiscrepancyNPE`
    and stacks set the probability to zero.

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

    Raises:
        InvalidInputError: If one of the first three is no list, or the probability is
            outside its range.

    Example:
        >>> z_s = torch.linspace(-1.0, 1.0, 20)[:, None]
        >>> noise = torch.tensor([[0.01]])
        >>> discrepancy = DiscrepancyModel().fit(0.5 * z_s + 2.0, z_s, noise)
        >>> draws = discrepancy.sample(1000, seed=0)
        >>> round(float(draws.gain.mean()), 1), round(float(draws.offset.mean()), 1)
        (0.5, 2.0)
        >>> discrepancy.probability_of_none < 1e-3
        True
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
        seed: int = 0,
    ) -> Discrepancy:
        r"""Return the posterior of the discrepancy given calibration pairs.

        If parameters are not known exactly, ``mean`` holds the means at R parameters
        that are equally probable before the observation is seen. The parameters are
        then imputed and the discrepancy is drawn in turn (data augmentation, a Gibbs
        sampler), in ten chains. The posterior is the average over two imputations of
        each chain, after 130 and after 160 rounds.

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
            groups: A number for each pair, shape ``(n,)``. The errors of pairs with the
                same number can have something in common, such as those of recordings of
                one person. None if all are independent. Do not divide the weights by
                the number of recordings as well: a group counts as fewer pairs anyway.
            seed: Seed of the imputations.

        Returns:
            The posterior, in float64.

        Raises:
            InvalidInputError: If the shapes do not fit, or a value is not finite.
        """
        width = np.shape(z)[-1:]
        z = as_batch("z", z, width).double()
        possible = np.shape(mean)[1:-1][:1]
        mean = as_batch("mean", mean, (*possible, *width), rows=len(z)).to(z)
        if possible == (1,):
            mean = mean[:, 0]
        covariance = as_batch("covariance", covariance, width, rows=width[0]).to(z)
        noise = covariance + SMALLEST_NOISE**2 * torch.eye(z.shape[1]).to(z)
        if weights is not None:
            weights = as_batch("weights", weights, (), rows=len(z)).to(z)
        if groups is not None:
            groups = as_batch("groups", groups, (), rows=len(z))
            groups = groups_of(groups).to(z.device)
            if len(groups.unique()) == len(groups):
                groups = None

        # Whether the simulator is right is judged with each group as one pair. With a
        # correlation that is a little too low, a right simulator would be refuted.
        once = weights if groups is None else independent_pairs(groups, 1.0, weights)

        def counts(mean: Tensor) -> Tensor | None:
            if groups is None:
                return weights
            correlations = self._correlations_within(groups, z, mean)
            return independent_pairs(groups, correlations, weights)

        def conditional(mean: Tensor, weights: Tensor | None) -> Conditional:
            return Conditional.of(
                z,
                mean,
                noise,
                gain_precisions=self.gain_precisions,
                settings=self._settings,
                prior_of_none=self.probability_of_none,
                weights=weights,
                once=once,
            )

        if mean.ndim == 2:
            [discrepancy] = conditional(mean[None], counts(mean[None])).posteriors()
            return discrepancy
        with seeded(seed):
            return impute(z, mean, conditional, counts)

    def _correlations_within(self, groups: Tensor, z: Tensor, mean: Tensor) -> Tensor:
        """Return the mean correlation of the errors of pairs of the same group.

        Args:
            groups: A number for each pair, shape ``(n,)``.
            z: Representations of the real observations, shape ``(n, l)``.
            mean: C sets of means, shape ``(C, n, l)``.

        Returns:
            Shape ``(C,)``.
        """
        ratios = torch.tensor(VARIANCE_RATIOS).to(z)
        correlations = ratios / (1 + ratios)
        evidence = []
        for correlation in correlations.tolist():
            errors = GroupErrors(groups=groups, correlation=correlation)
            # Half of the precisions are enough to compare correlations.
            some = Regressions.of(z, mean, self.gain_precisions[::2], errors=errors)
            evidence.append(some.log_evidence(self._settings).logsumexp(dim=(1, 2)))
        log_prior = torch.tensor(PRIOR_OF_RATIOS).to(z).log()
        return (torch.stack(evidence, dim=1) + log_prior).softmax(dim=1) @ correlations

    @property
    def _settings(self) -> list[tuple[float, float]]:
        return list(itertools.product(self.error_scales, self.degrees_of_freedom))
