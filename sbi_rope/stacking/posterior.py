"""The stack of candidates, as an sbi posterior."""

import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._sbi import describe
from sbi_rope._validation import check_tables
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import MixturePosterior
from sbi_rope.stacking.guaranteed import HeldOutSets
from sbi_rope.stacking.recalibrating import recalibrated
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.versions import Versions

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
    support of the prior. With couplings among the candidates the posterior belongs to a
    batch, as RoPE's does. Without couplings it answers any x. It has all methods of
    :class:`~sbi_rope.MixturePosterior`.

    sbi's ``EnsemblePosterior`` is not used, for three reasons. It has no
    ``log_prob_batched``. It corrects the leakage of each candidate separately, and for
    NPE on misspecified data this does not end. It draws the same number of samples
    from a candidate for all observations of a batch.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        versions: The candidates in all versions.
        prior: The prior NPE was trained with.
        report: The held-out scores of the stack and its candidates.
        enable_transform: As in sbi, for ``map()``.
    """

    def __init__(
        self,
        versions: Versions,
        prior: Distribution,
        *,
        report: StackingReport,
        enable_transform: bool = True,
    ) -> None:
        weights = report.cross_validation.weights.weights
        estimator = recalibrated(
            versions.estimator(weights), report.recalibration, prior
        )
        if versions.couplings is not None:
            # The same object as in the estimator, so that both move to a device
            # together.
            couplings = replace(versions.couplings, part=estimator.parts[0])
            versions = replace(versions, couplings=couplings)
        super().__init__(
            estimator, copy.deepcopy(prior), enable_transform=enable_transform
        )
        self._versions: Versions | None = versions
        self.report = report
        describe(
            self,
            f"It is the stack of {len(weights)} candidate posteriors, weighted by "
            "their scores on held-out calibration pairs.",
        )

    @property
    def versions(self) -> Versions:
        """All versions of the candidates.

        Raises:
            InvalidInputError: If this is the posterior of one observation of a batch.
        """
        if self._versions is None:
            raise InvalidInputError(
                "Expected the posterior of the whole batch, which knows its candidates "
                "one by one; got that of a single observation. Use `posterior.versions`"
                " or `posterior.candidate_log_probs` instead of those of "
                "`posterior[i]`."
            )
        return self._versions

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
            InvalidInputError: If shapes do not fit, or if this is the posterior of one
                observation of a batch.
            UnseenObservationError: If the posterior belongs to a batch that does not
                contain an x, and ``unseen="raise"``.
        """
        check_tables(self, theta=theta)
        return self.versions.log_probs(theta, self._batch_of_x(x))

    def _held_out_sets(self) -> HeldOutSets:
        if self._versions is None:
            raise InvalidInputError(
                "Expected the posterior of the whole batch for a set with a guarantee, "
                "because it needs the candidates one by one; got that of a single "
                "observation. Use `posterior.credible_set(x=x_o[i], guaranteed=True)` "
                "instead of `posterior[i].credible_set(guaranteed=True)`, and the same "
                "for `credible_intervals`."
            )
        return HeldOutSets(self, self._versions)

    def __getitem__(self, index: int) -> "StackedPosterior":
        """Return the posterior of one observation, which is then the default x.

        It does not contain the other observations of the batch.
        """
        view: Any = super().__getitem__(index)
        view._versions = None
        return view
