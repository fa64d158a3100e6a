"""The stack of candidates as an sbi posterior, and its sets with a guarantee."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._sbi import MixedDensity
from sbi_rope.density import Density, Flow, Mixture, MixturePosterior
from sbi_rope.errors import InvalidInputError
from sbi_rope.sets import CredibleIntervals, CredibleSet, Guarantee
from sbi_rope.sets.conformal import (
    check_enough,
    interval_of,
    is_held,
    joint_scores,
    marginal_ends,
    rank_needed,
)
from sbi_rope.stacking.cross_validation import SetScores
from sbi_rope.stacking.report import StackingReport
from sbi_rope.tensors import as_batch, check_same_length

__all__ = ["StackedPosterior", "Versions", "fold_posterior", "mixture_of"]

# How far the draws that the volume of a set is estimated from are moved from their
# mean.
STRETCHES = (1.0, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class Versions:
    """The densities of a candidate, one for each version, and their average.

    A stack is made of the models that were scored: the candidate is deployed as the
    average of its versions. Flows are averaged in one network, from which each version
    can be taken out.

    Attributes:
        average: The average of all versions with equal weights.
        place: The number of each version among those that differ.
        sizes: How many flows of the average belong to each that differs.
    """

    average: Density
    place: list[int]
    sizes: list[int]

    @classmethod
    def of(cls, densities: Sequence[Density]) -> "Versions":
        """Return the versions of a candidate; equal ones are one object."""
        different = list({id(one): one for one in densities}.values())
        place = [[one is other for other in different].index(True) for one in densities]
        sizes = [1] * len(different)
        if len(different) == 1:
            return cls(different[0], place, sizes)
        flows = [one for one in different if isinstance(one, Flow)]
        if len(flows) == len(different):
            sizes = [one.num_members for one in flows]
            return cls(Flow.joined(flows), place, sizes)
        return cls(Mixture(different, [1 / len(sizes)] * len(sizes)), place, sizes)

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, version: int) -> Density:
        """Return the density of one version."""
        number, average = self.place[version], self.average
        if len(self.sizes) == 1:
            return average
        if isinstance(average, Flow):
            start = sum(self.sizes[:number])
            return average[torch.arange(start, start + self.sizes[number])]
        assert isinstance(average, Mixture)
        return average.parts[number]


def mixture_of(
    candidates: Sequence[Versions], weights: Tensor, version: int | None = None
) -> Mixture:
    """Return the mixture of candidates in one version, or in the average of all."""
    parts = [one.average if version is None else one[version] for one in candidates]
    return Mixture(parts, weights)


def fold_posterior(mixture: Mixture, prior: Distribution) -> MixturePosterior:
    """Return the posterior of a stack that has not seen a fold.

    It does not warn of observations that are far from simulations, because RoPE has.
    """
    posterior = MixturePosterior(mixture, prior, enable_transform=False)
    posterior.warns = False
    return posterior


class StackedPosterior(MixturePosterior):
    r"""A weighted mixture of candidate posteriors.

    .. math::
        p(\theta \mid x)
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z(x)}
        \sum_k w_k \frac1V \sum_v q_k^{(v)}(\theta \mid x),

    Here :math:`w_k` are the weights of :func:`~sbi_rope.stacking.stacking_weights`, and
    :math:`q_k^{(v)}` are the V versions of candidate k: one trained without each fold
    of the calibration pairs, and one trained on all pairs. Z(x) is the mass inside the
    support of the prior. It answers any x, and has all methods of
    :class:`~sbi_rope.MixturePosterior`.

    sbi's ``EnsemblePosterior`` is not used, for three reasons. It has no
    ``log_prob_batched``. It corrects the leakage of each candidate separately, and for
    NPE on misspecified data this does not end. It draws the same number of samples
    from a candidate for all observations of a batch.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        versions: Each candidate in all its versions.
        prior: The prior NPE was trained with.
        report: The held-out scores of the stack and its candidates.
        enable_transform: As in sbi, for ``map()``.
    """

    def __init__(
        self,
        versions: Sequence[Versions],
        prior: Distribution,
        *,
        report: StackingReport,
        enable_transform: bool = True,
    ) -> None:
        weights = report.weights.weights
        super().__init__(
            mixture_of(versions, weights),
            prior,
            enable_transform=enable_transform,
        )
        self.versions = list(versions)
        self.report = report

    @property
    def candidate_weights(self) -> dict[str, float]:
        """The weight of each candidate, by name. The weights sum to one."""
        weights = self.report.weights.weights.tolist()
        return dict(zip(self.report.names, weights, strict=True))

    @torch.no_grad()
    def candidate_log_probs(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Each density is the average of the versions, not corrected for leakage.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.

        Returns:
            Shape ``(n, K)``, float64, in the order of ``candidate_weights``.

        Raises:
            InvalidInputError: If shapes do not fit.
        """
        theta = as_batch(
            "theta",
            theta,
            self.posterior_estimator.input_shape,
            names=self.parameter_names,
        )
        x = self._batch_of_x(x)
        check_same_length(theta, x)
        x = x.to(self.posterior_estimator.device)
        log_probs = [one.average.log_prob(theta[None], x)[0] for one in self.versions]
        return torch.stack(log_probs, dim=1).double()

    def _held_out_sets(self) -> "HeldOutSets":
        return HeldOutSets(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutRule:
    """The parameters whose scores are not higher than those of most pairs.

    Attributes:
        posteriors: The stack that has not seen each fold.
        x: The observation.
        draws: Log densities of draws of each posterior at x, shape ``(K, M)``.
        scores: The scores of the pairs that count, shape ``(n,)``.
        fold: The fold of each of them, shape ``(n,)``.
        level: The level that was asked for.
    """

    posteriors: tuple[MixturePosterior, ...]
    x: Tensor
    draws: Tensor
    scores: Tensor
    fold: Tensor
    level: float

    def contains(self, theta: Tensor) -> Tensor:
        """Return whether parameters ``(n, d)`` are in the set, shape ``(n,)``.

        Those outside the prior's support have infinite scores, and are not.
        """
        log_probs = [
            _log_prob(posterior, theta, self.x) for posterior in self.posteriors
        ]
        at_theta = joint_scores(torch.stack(log_probs), self.draws)
        return is_held(self.scores, self.fold, at_theta, level=self.level)


class HeldOutSets:
    """Makes sets with a guarantee from the held-out scores of a stack.

    The scores are those of the stacks that have not seen a fold, and a new observation
    is scored by the same stacks, with as many draws.

    Args:
        posterior: The stack.
    """

    def __init__(self, posterior: StackedPosterior) -> None:
        self._posterior = posterior
        self._report = posterior.report

    @torch.no_grad()
    def credible_set(self, level: float, x: Tensor, num_samples: int) -> CredibleSet:
        """Return a set with a guarantee, see ``MixturePosterior.credible_set``.

        If the stack is too narrow, the set reaches further than its draws. A quarter of
        the draws that the volume is estimated from are therefore those of the stack,
        two quarters the same at two and at four times their distance from the mean,
        and a quarter those of the prior.
        """
        scores, guarantee = self._scores(level)
        counted = scores.is_counted
        _check_finite(scores.joint[counted], level)
        theta, log_density = self._spread(x, num_samples)
        posteriors = self._posteriors(scores)
        draws = [
            _log_prob(posterior, _sample(posterior, x, scores)[:, 0], x)
            for posterior in posteriors
        ]
        rule = HeldOutRule(
            posteriors=posteriors,
            x=x,
            draws=torch.stack(draws),
            scores=scores.joint[counted].to(x.device),
            fold=self._report.fold[counted].to(x.device),
            level=level,
        )
        return CredibleSet.of(
            rule,
            theta,
            log_density,
            level=level,
            log_unit=float(self._posterior.prior.log_units().sum()),
            guarantee=guarantee,
        )

    @torch.no_grad()
    def credible_intervals(self, level: float, x: Tensor) -> CredibleIntervals:
        """Return intervals with a guarantee for each observation, each by itself.

        The score of a pair is the level of the smallest central interval that contains
        its parameter. At x this score gives an interval under the posterior of its
        fold. The interval with a guarantee ends at quantiles of the ends of these n
        intervals, and at the end of the prior's support.
        """
        scores, guarantee = self._scores(level)
        low, high = [], []
        for number, posterior in enumerate(self._posteriors(scores)):
            rows = scores.is_counted & (self._report.fold == number)
            draws = _sample(posterior, x, scores).permute(1, 2, 0)
            of_pairs = scores.marginal[rows].T.to(draws.device)
            ends = marginal_ends(of_pairs.expand(len(x), -1, -1), draws)
            low.append(ends[0].permute(2, 0, 1))
            high.append(ends[1].permute(2, 0, 1))
        ends = interval_of(torch.cat(low), torch.cat(high), level=level)
        least, most = self._posterior.prior.bounds(ends[0])
        return CredibleIntervals(
            low=ends[0].clamp(least, most).to(x),
            high=ends[1].clamp(least, most).to(x),
            level=level,
            guarantee=guarantee,
        )

    def _scores(self, level: float) -> tuple[SetScores, Guarantee]:
        """Return the scores and what they promise; raise if there are too few."""
        scores = self._report.set_scores
        if scores is None:
            raise InvalidInputError(
                "Expected some exact labels for a set with a guarantee; got "
                f"{self._report.labels}."
            )
        check_enough(level, len(scores))
        guarantee = Guarantee(
            level=level,
            num_pairs=len(scores),
            num_folds=self._report.num_folds,
        )
        return scores, guarantee

    def _posteriors(self, scores: SetScores) -> tuple[MixturePosterior, ...]:
        """Return the stack that has not seen each fold."""
        return tuple(
            fold_posterior(
                mixture_of(self._posterior.versions, weights, version=number),
                self._posterior.prior,
            )
            for number, weights in enumerate(scores.weights)
        )

    def _spread(self, x: Tensor, num_samples: int) -> tuple[Tensor, Tensor]:
        r"""Return draws that reach further than the stack, and their log density.

        .. math:: q(\theta) = \frac14 \Big( p(\theta) + \sum_{s \in \{1, 2, 4\}}
            s^{-d}\, p\big(\mu + (\theta - \mu) / s \mid x\big) \Big)

        Here :math:`\mu` is the mean of the draws. Mixed discrete and continuous
        parameters are not stretched, because they would be between the categories.
        """
        posterior, prior = self._posterior, self._posterior.prior
        modules = posterior.posterior_estimator.modules()
        is_mixed = any(isinstance(module, MixedDensity) for module in modules)
        stretches = STRETCHES[:1] if is_mixed else STRETCHES
        count = math.ceil(num_samples / (1 + len(stretches)))
        draws = posterior.sample((count,), x=x, show_progress_bars=False)
        mean = draws.mean(dim=0)
        theta = torch.cat(
            [
                prior.sample((count,)).to(draws),
                *(_stretched(draws, mean, by=stretch) for stretch in stretches),
            ]
        )
        shrunk = [_stretched(theta, mean, by=1 / stretch) for stretch in stretches]
        # In one call, because the mass inside the support is estimated in each.
        log_prob = posterior.log_prob(torch.cat(shrunk), x=x).double()
        scales = torch.tensor(stretches).to(log_prob).log() * theta.shape[1]
        terms = torch.cat(
            [
                prior.log_prob(theta).to(log_prob)[None],
                log_prob.reshape(len(stretches), -1) - scales[:, None],
            ]
        )
        return theta, terms.logsumexp(dim=0) - math.log(len(terms))


def _sample(posterior: MixturePosterior, x: Tensor, scores: SetScores) -> Tensor:
    """Draw as often as for the scores of the pairs, ``(M, B, d)``."""
    return posterior.sample_batched((scores.num_draws,), x, show_progress_bars=False)


def _log_prob(posterior: MixturePosterior, theta: Tensor, x: Tensor) -> Tensor:
    """Return the log density up to a constant, which scores do not depend on.

    The constant is the mass inside the prior's support, which takes long to estimate.
    """
    return posterior.log_prob(theta, x=x, norm_posterior=False)


def _stretched(theta: Tensor, centre: Tensor, *, by: float) -> Tensor:
    return theta if by == 1 else centre + by * (theta - centre)


def _check_finite(scores: Tensor, level: float) -> None:
    """Raise if so many labels are impossible that a set would hold everything."""
    impossible = int(torch.isinf(scores).sum())
    if impossible > len(scores) - rank_needed(level, len(scores)):
        raise InvalidInputError(
            "Expected labels that the held-out stack gives a density above zero; got "
            f"{impossible} of {len(scores)} without, so that a set of level {level:g} "
            "would hold every parameter. Leave out labels outside the prior's support, "
            "ask for a smaller level, or add the prior to the candidates."
        )
