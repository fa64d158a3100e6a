"""The stack of candidates, as an sbi posterior."""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._sbi import describe
from sbi_rope.density import MixturePosterior
from sbi_rope.stacking.guaranteed import HeldOutSets
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.versions import Versions, mixture_of
from sbi_rope.tensors import as_batch, check_same_length

__all__ = ["StackedPosterior"]


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
        weights = report.cross_validation.weights.weights
        super().__init__(
            mixture_of(versions, weights),
            copy.deepcopy(prior),
            enable_transform=enable_transform,
        )
        self.versions = list(versions)
        self.report = report
        describe(
            self,
            f"It is the stack of {len(weights)} candidate posteriors, weighted by "
            "their scores on held-out calibration pairs.",
        )

    @property
    def candidate_weights(self) -> dict[str, float]:
        """The weight of each candidate, by name. The weights sum to one."""
        scores = self.report.cross_validation
        return dict(zip(scores.names, scores.weights.weights.tolist(), strict=True))

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

    def _held_out_sets(self) -> HeldOutSets:
        return HeldOutSets(self)
