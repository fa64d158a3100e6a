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


@dataclass(frozen=True, eq=False)
class Versions:
    """The average of a candidate's versions, and each version by itself.

    Flows are averaged in one network; a version is then the numbers of its flows.
    """

    average: Density
    parts: list[Density] | list[list[int]]

    @classmethod
    def of(cls, densities: Sequence[Density]) -> "Versions":
        """Return the versions of a candidate, which may all be the same object."""
        if len({id(one) for one in densities}) == 1:
            return cls(densities[0], [*densities])
        flows = [one for one in densities if isinstance(one, Flow)]
        if len(flows) < len(densities):
            shares = [1 / len(densities)] * len(densities)
            return cls(Mixture(densities, shares), [*densities])
        sizes = [one.num_members for one in flows]
        parts = torch.arange(sum(sizes)).split(sizes)
        return cls(Flow.joined(flows), [part.tolist() for part in parts])

    def __getitem__(self, version: int) -> Density:
        part = self.parts[version]
        if isinstance(part, Density):
            return part
        assert isinstance(self.average, Flow)
        return self.average[part]


def fold_posterior(
    densities: Sequence[Density], weights: Tensor, prior: Distribution
) -> MixturePosterior:
    """Return the posterior of a stack that has not seen a fold.

    It does not warn of observations that are far from simulations, because RoPE has.
    """
    mixture = Mixture(densities, weights)
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
        mixture = Mixture([one.average for one in versions], report.weights)
        super().__init__(mixture, prior, enable_transform=enable_transform)
        self.versions = list(versions)
        self.report = report

    @property
    def candidate_weights(self) -> dict[str, float]:
        """The weight of each candidate, by name. The weights sum to one."""
        return dict(zip(self.report.names, self.report.weights.tolist(), strict=True))

    def _held_out(self) -> tuple[SetScores, list[MixturePosterior]]:
        if (scores := self.report.set_scores) is None:
            raise InvalidInputError(
                "Expected some exact labels for a set with a guarantee; got "
                f"{self.report.labels}."
            )
        return scores, [
            fold_posterior([one[k] for one in self.versions], weights, self.prior)
            for k, weights in enumerate(scores.weights)
        ]
