"""The stack of candidates as an sbi posterior."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.errors import NotReadyError
from sbi_rope.mixture import MixturePosterior
from sbi_rope.stacking.estimator import StackedEstimator

if TYPE_CHECKING:
    from sbi_rope.stacking.report import StackingReport

__all__ = ["StackedPosterior"]


class StackedPosterior(MixturePosterior):
    r"""A weighted mixture of candidate posteriors for a batch of real observations.

    .. math::
        p(\theta \mid x_{o,i})
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z_i}
        \sum_k w_k\, q_k(\theta \mid x_{o,i}),
        \qquad Z_i = \sum_k w_k Z_k(x_{o,i}),

    with the weights of :func:`stacking_weights` and :math:`Z_k` the mass of candidate k
    inside the support of the prior. The couplings among the candidates share their
    components, so that together they cost as much as one. It has all methods of
    :class:`~sbi_rope.MixturePosterior`.

    sbi's ``EnsemblePosterior`` is not used: it has no ``log_prob_batched``, corrects
    each candidate's leakage by itself, which does not end for NPE on misspecified data,
    and gives all observations of a batch the same number of draws of each candidate.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        estimator: The stack.
        prior: The prior NPE was trained with.
        weights: Of each candidate by name; they sum to one.
        report: What the calibration pairs say about it; None of the stacks inside a
            cross-validation.
        enable_transform: As in sbi, for ``map()``.
        shared: As in :class:`~sbi_rope.MixturePosterior`.
    """

    def __init__(
        self,
        estimator: StackedEstimator,
        prior: Distribution,
        *,
        weights: dict[str, float],
        report: "StackingReport | None" = None,
        enable_transform: bool = True,
        shared: dict[int, Tensor] | None = None,
    ) -> None:
        super().__init__(
            estimator, prior, enable_transform=enable_transform, shared=shared
        )
        self.candidate_weights = weights
        self._report = report
        self._purpose = (
            f"It is the stack of {len(weights)} candidate posteriors for each of "
            f"{len(self)} real observations."
        )

    @torch.no_grad()
    def candidate_log_probs(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Couplings are normalised inside the support of the prior, as RoPE's posteriors
        are; the other densities are as they are.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.

        Returns:
            Shape ``(n, K)``, float64, in the order of ``candidate_weights``.
        """
        x = self._batch_of_x(x)
        estimator = self.posterior_estimator
        assert isinstance(estimator, StackedEstimator)
        mass = None
        if self._bound is not None:
            mass = estimator.component_mass(0, accept=self._bound, cache=self._cache)
        return estimator.candidate_log_probs(theta, x, component_mass=mass)

    @property
    def report(self) -> "StackingReport":
        """What the calibration pairs say about this stack; print it.

        Raises:
            NotReadyError: If this stack is itself a part of a cross-validation.
        """
        if self._report is None:
            raise NotReadyError(
                "This stack was made to score held-out pairs and has no report. Use "
                "that of the posterior that `stack(rope, x_o)` returns."
            )
        return self._report
