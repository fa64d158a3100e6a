"""The stack of candidates as an sbi posterior."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.density import Density, Flow, Mixture, MixturePosterior
from sbi_rope.density.sets import SetScores
from sbi_rope.stacking.report import StackingReport
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.tensors import as_batch


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
        x = self._batch_of_x(x)
        theta = as_batch(
            "theta",
            theta,
            self.posterior_estimator.input_shape,
            rows=len(x),
            names=self.parameter_names,
        )
        x = x.to(self.posterior_estimator.device)
        log_probs = [one.average.log_prob(theta[None], x)[0] for one in self.versions]
        return torch.stack(log_probs, dim=1).double()

    def _held_out(self) -> tuple[SetScores, list[MixturePosterior]]:
        if (scores := self.report.set_scores) is None:
            raise InvalidInputError(
                "Expected some exact labels for a set with a guarantee; got "
                f"{self.report.labels}."
            )
        return scores, [
            fold_posterior(mixture_of(self.versions, weights, number), self.prior)
            for number, weights in enumerate(scores.weights)
        ]
