"""The weights of candidates by their out-of-fold scores."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.settings import Count, NotNegative, Positive, check
from sbi_rope.utils.tensors import as_batch, as_numbers


@dataclass(frozen=True, eq=False, kw_only=True)
class StackingWeights:
    """The weights of candidates, and a bound on how far they are from the best.

    Attributes:
        weights: On the simplex, shape ``(K,)``, float64.
        score: The mean log score of the stack over the pairs that the weights were
            fitted to. It is too high for new pairs.
        gap: The objective, a sum over pairs, is at most this far below its maximum, in
            nats.
        num_iterations: The number of iterations of EM.
        converged: Whether the gap is at most the tolerance.
    """

    weights: Tensor
    score: float
    gap: float
    num_iterations: int
    converged: bool


def stacking_weights(
    log_scores: Tensor,
    *,
    pair_weights: Tensor | None = None,
    pseudo_count: float = 1.0,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
) -> StackingWeights:
    r"""Return the weights whose mixture of candidates scores best on held-out pairs.

    With the log score :math:`\ell_{ik}` of candidate k at pair i,

    .. math::
        \max_{w \in \Delta} \; \sum_{i=1}^{n} \log \sum_{k=1}^{K} w_k e^{\ell_{ik}}
        + \frac{c}{K} \sum_{k=1}^{K} \log w_k ,

    the mode under a Dirichlet prior with all parameters :math:`1 + c / K`. The prior
    counts as c pairs at which all candidates share the responsibility equally. With few
    pairs it prevents that a single candidate gets all the weight; with many pairs its
    effect vanishes. The problem is concave, and for c > 0 the solution is unique. EM
    starts from equal weights and repeats
    :math:`w_k \leftarrow (\sum_i r_{ik} + c / K) / (n + c)` with the responsibilities
    :math:`r_{ik} = w_k e^{\ell_{ik}} / \sum_m w_m e^{\ell_{im}}`.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        log_scores: :math:`\ell`, shape ``(n, K)``. Minus infinity is allowed, NaN and
            plus infinity are not. A pair that has minus infinity for all candidates is
            left out, with a warning.
        pair_weights: How many pairs each pair counts as, shape ``(n,)``: a factor of
            its term in the sum over i. One if None.
        pseudo_count: c, at least 0.
        tolerance: EM has converged when ``gap`` is at most this.
        max_iterations: EM stops after so many iterations, converged or not.

    Returns:
        The weights.

    Raises:
        InvalidInputError: If a shape does not fit, a score is NaN or plus infinity, or
            an argument is outside its range.

    Example:
        >>> log_scores = torch.tensor([[0.0, -9.0], [0.0, -9.0], [-9.0, 0.0]])
        >>> stacking_weights(log_scores, pseudo_count=0.0).weights.round(decimals=3)
        tensor([0.6670, 0.3330], dtype=torch.float64)
    """
    scores, of_pairs = _checked_scores(log_scores, pair_weights)
    check("pseudo_count", pseudo_count, NotNegative)
    check("tolerance", tolerance, Positive)
    check("max_iterations", max_iterations, Count)
    # Relative to the best candidate at each pair, so that exp does not over- or
    # underflow.
    density = (scores - scores.max(dim=1, keepdim=True).values).exp()
    num_candidates = density.shape[1]
    n = float(of_pairs.sum())
    share = pseudo_count / num_candidates
    weights = density.new_full((num_candidates,), 1.0 / num_candidates)
    gap, iteration = math.inf, 0
    for iteration in range(max_iterations + 1):
        # The derivative of the objective by the weight of each candidate.
        ratio = density / (density @ weights)[:, None]
        gradient = (ratio * of_pairs[:, None]).sum(dim=0)
        if share:
            gradient = gradient + share / weights
        # The objective is concave, so that it lies below its tangent everywhere.
        gap = float(gradient.max()) - (n + pseudo_count)
        if gap <= tolerance or iteration == max_iterations:
            break
        weights = weights * gradient
        weights = weights / weights.sum()
    mixed = torch.logsumexp(scores + weights.log(), dim=1)
    return StackingWeights(
        weights=weights,
        score=float((of_pairs * mixed).sum() / of_pairs.sum()),  # NaN of none
        gap=max(gap, 0.0),
        num_iterations=iteration,
        converged=gap <= tolerance,
    )


def _checked_scores(
    log_scores: Tensor, pair_weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the scores and weights of the pairs that a candidate does not exclude."""
    scores = as_numbers("log_scores", log_scores).double()
    if scores.ndim != 2 or not scores.shape[1]:
        raise InvalidInputError(
            f"Expected `log_scores` of shape (n, K); got {tuple(scores.shape)}."
        )
    if bool((scores.isnan() | scores.isposinf()).any()):
        raise InvalidInputError("Expected `log_scores` below infinity; got NaN or Inf.")
    of_pairs = scores.new_ones(len(scores))
    if pair_weights is not None:
        of_pairs = as_batch("pair_weights", pair_weights, (), rows=len(scores))
        if not bool((of_pairs > 0).all()):
            raise InvalidInputError(
                f"Expected positive `pair_weights`; got {float(of_pairs.min())}."
            )
    known = ~scores.isneginf().all(dim=1)
    if not known.all():
        warn_user(
            f"{int((~known).sum())} of {len(scores)} held-out pairs have density zero "
            "under every candidate and are left out of the weights. Add the prior as a "
            "candidate."
        )
    return scores[known], of_pairs.to(scores)[known]


def fold_weights(
    log_scores: Tensor, fold: Tensor, weight: Tensor | None = None
) -> Tensor:
    """Return the weights fitted without each of the F folds, shape ``(F, K)``."""
    found = []
    for number in range(int(fold.max()) + 1):
        rows = fold != number
        of_pairs = None if weight is None else weight[rows]
        found.append(stacking_weights(log_scores[rows], pair_weights=of_pairs).weights)
    return torch.stack(found).to(log_scores)
