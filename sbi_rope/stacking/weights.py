"""The weights of candidates by their out-of-fold scores."""

import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.tensors import as_batch, as_numbers

# The prior of the weights counts as so many pairs.
PSEUDO_COUNT = 1.0
# EM stops when the objective, a sum over pairs, is so few nats below its maximum, or
# after so many steps.
TOLERANCE, MAX_STEPS = 1e-3, 20_000


def stacking_weights(
    log_scores: Tensor, *, pair_weights: Tensor | None = None
) -> Tensor:
    r"""Return the weights whose mixture of candidates scores best on hold-out pairs.

    With the log score :math:`\ell_{ik}` of candidate k at pair i,

    .. math::
        \max_{w \in \Delta} \; \sum_{i=1}^{n} \log \sum_{k=1}^{K} w_k e^{\ell_{ik}}
        + \frac1K \sum_{k=1}^{K} \log w_k ,

    the mode under a Dirichlet prior with all parameters :math:`1 + 1 / K`. The prior
    counts as one pair at which all candidates share the responsibility equally. With
    few pairs it prevents that a single candidate gets all the weight; with many pairs
    its effect vanishes. The problem is concave with a unique solution. EM starts from
    equal weights and repeats
    :math:`w_k \leftarrow (\sum_i r_{ik} + 1 / K) / (n + 1)` with the responsibilities
    :math:`r_{ik} = w_k e^{\ell_{ik}} / \sum_m w_m e^{\ell_{im}}`, until the objective
    is at most 0.001 nats below its maximum.

    References:
        | Using Stacking to Average Bayesian Predictive Distributions (Yao et al., 2018)
        | https://arxiv.org/abs/1704.02030

    Args:
        log_scores: :math:`\ell`, shape ``(n, K)``. Minus infinity is allowed, NaN and
            plus infinity are not. A pair that has minus infinity for all candidates is
            left out, with a warning.
        pair_weights: How many pairs each pair counts as, shape ``(n,)``: a factor of
            its term in the sum over i. One if None.

    Returns:
        The weights, which sum to one, shape ``(K,)``, float64.

    Raises:
        InvalidInputError: If a shape does not fit, or a score is NaN or plus infinity.

    Example:
        >>> log_scores = torch.tensor([[0.0, -9.0], [0.0, -9.0], [-9.0, 0.0]])
        >>> stacking_weights(log_scores).round(decimals=3)
        tensor([0.6250, 0.3750], dtype=torch.float64)
    """
    scores = as_numbers("log_scores", log_scores).double()
    if scores.ndim != 2 or not scores.shape[1]:
        raise InvalidInputError(
            f"Expected `log_scores` of shape (n, K); got {tuple(scores.shape)}."
        )
    if bool((scores.isnan() | scores.isposinf()).any()):
        raise InvalidInputError("Expected `log_scores` below infinity; got NaN or Inf.")
    count = scores.new_ones(len(scores))
    if pair_weights is not None:
        count = as_batch("pair_weights", pair_weights, (), rows=len(scores)).to(scores)
    known = ~scores.isneginf().all(dim=1)
    if not known.all():
        warn_user(
            f"{int((~known).sum())} of {len(scores)} held-out pairs have density zero "
            "under every candidate and are left out of the weights. Add the prior as a "
            "candidate."
        )
    scores, count = scores[known], count[known]
    # Relative to the best candidate at each pair, so that exp does not over- or
    # underflow.
    density = (scores - scores.max(dim=1, keepdim=True).values).exp()
    total, share = float(count.sum()) + PSEUDO_COUNT, PSEUDO_COUNT / density.shape[1]
    weights = density.new_full((density.shape[1],), 1.0 / density.shape[1])
    for _ in range(MAX_STEPS):
        # The derivative of the objective by the weight of each candidate.
        ratio = density / (density @ weights)[:, None]
        gradient = (ratio * count[:, None]).sum(dim=0) + share / weights
        # The objective is concave, so that it lies below its tangent everywhere.
        if float(gradient.max()) - total <= TOLERANCE:
            break
        weights = weights * gradient
        weights = weights / weights.sum()
    else:
        warn_user(
            f"The weights have not converged in {MAX_STEPS:,} steps. Leave out "
            "candidates that are nearly the same."
        )
    return weights


def fold_weights(
    log_scores: Tensor, fold: Tensor, weight: Tensor | None = None
) -> Tensor:
    """Return the weights fitted without each of the F folds, shape ``(F, K)``."""
    weight = torch.ones_like(log_scores[:, 0]) if weight is None else weight
    others = [fold != number for number in range(int(fold.max()) + 1)]
    found = [
        stacking_weights(log_scores[rows], pair_weights=weight[rows]) for rows in others
    ]
    return torch.stack(found).to(log_scores)
