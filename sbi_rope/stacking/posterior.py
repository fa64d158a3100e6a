"""The stack of candidates as an sbi posterior."""

import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._sbi import describe
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import MixturePosterior
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.versions import Versions

__all__ = ["StackedPosterior"]


class StackedPosterior(MixturePosterior):
    r"""A weighted mixture of candidate posteriors.

    .. math::
        p(\theta \mid x)
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z(x)}
        \sum_k w_k \frac1V \sum_v q_k^{(v)}(\theta \mid x),

    with the weights of :func:`stacking_weights`, the versions :math:`q_k^{(v)}` of
    candidate k, each trained without one fold of the calibration pairs or on all, and
    Z(x) the mass inside the support of the prior. With couplings among the candidates
    it belongs to a batch, as RoPE's posterior does; without, it answers any x. It has
    all methods of :class:`~sbi_rope.MixturePosterior`.

    sbi's ``EnsemblePosterior`` is not used: it has no ``log_prob_batched``, corrects
    each candidate's leakage by itself, which does not end for NPE on misspecified data,
    and gives all observations of a batch the same number of draws of each candidate.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        versions: The candidates.
        prior: The prior NPE was trained with.
        report: What the calibration pairs say about it.
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
        estimator = versions.estimator(weights)
        if versions.couplings is not None:
            # The same object, so that both move to a device together.
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
        """The candidates, each as trained without each fold of the pairs.

        Raises:
            InvalidInputError: If it is the posterior of one observation of a batch.
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
        """The weight of each candidate by name; they sum to one."""
        scores = self.report.cross_validation
        return dict(zip(scores.names, scores.weights.weights.tolist(), strict=True))

    @torch.no_grad()
    def candidate_log_probs(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Each is the average of its versions, not corrected for leakage.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.

        Returns:
            Shape ``(n, K)``, float64, in the order of ``candidate_weights``.

        Raises:
            InvalidInputError: If shapes do not fit, or it is the posterior of one
                observation of a batch.
            UnseenObservationError: If it belongs to a batch, an x is not in it, and
                ``unseen="raise"``.
        """
        return self.versions.log_probs(theta, self._batch_of_x(x))

    def __getitem__(self, index: int) -> "StackedPosterior":
        """Return the posterior of one observation, with it as the default x.

        It knows no other observation of the batch.
        """
        view: Any = super().__getitem__(index)
        view._versions = None
        return view
