"""The log density of a block of mixtures."""

import torch
from torch import Tensor

from sbi_rope.errors import warn_user
from sbi_rope.mixture.block import Block, Entries
from sbi_rope.mixture.chunks import flow_batch, num_fitting

__all__ = ["block_log_prob", "without_nan"]


def block_log_prob(theta: Tensor, block: Block, *, tail_mass: float) -> Tensor:
    """Return the log density at theta ``(S, b, d)``, shape ``(S, b)``, float64.

    Args:
        theta: Parameters, S for each of the b observations.
        block: The weighted embeddings of these observations.
        tail_mass: Weight of the smallest entries of each row that may be left out.
    """
    row, column, log_weights = block.without_tail(tail_mass)
    by_part = block.by_part(row, column)
    order = torch.cat([entries.which for entries in by_part])
    row, log_weights = row[order], log_weights[order]
    log_probs = []
    for some in theta.split(num_fitting(len(row))):
        log_q = torch.cat([_log_q(some, entries) for entries in by_part], dim=1)
        log_terms = without_nan(log_q.double()) + log_weights
        log_probs.append(_log_sum_exp(log_terms, row, len(block.weights)))
    return torch.cat(log_probs)


def _log_q(theta: Tensor, entries: Entries) -> Tensor:
    """Evaluate K entries at theta of their row, ``(S, b, d)`` to ``(S, K)``.

    The flow sees batches of its own size, whatever rows and samples they mix.
    """
    row = entries.row
    shape = (len(theta), len(row))
    pairs = torch.arange(len(theta) * len(row), device=theta.device)
    log_q = []
    for batch in pairs.split(flow_batch(theta.device)):
        sample, k = batch // len(row), batch % len(row)
        points = theta[sample, row[k]]
        if points.requires_grad:
            # A component whose density is NaN at its point has no gradient there.
            points.register_hook(lambda grad: grad.nan_to_num(nan=0.0))
        log_q.append(entries.part.log_prob(points, entries.embeddings(k)))
    return torch.cat(log_q).reshape(shape)


def without_nan(log_q: Tensor) -> Tensor:
    """Count NaN densities of components as zero, so that the sum is not NaN."""
    undefined = torch.isnan(log_q)
    if not undefined.any():
        return log_q
    warn_user(
        f"{int(undefined.sum())} of {undefined.numel()} component densities are NaN "
        "and count as zero, because the density fails at these parameters or "
        "observations. Look for observations that are far from all simulations. If "
        "there are none, train NPE longer, or with another density estimator."
    )
    return log_q.where(~undefined, -torch.inf)


def _log_sum_exp(log_terms: Tensor, row: Tensor, num_rows: int) -> Tensor:
    """Sum the terms ``(S, K)`` of each row, ``(S, num_rows)``."""
    index = row.expand_as(log_terms)
    shape = (len(log_terms), num_rows)
    largest = log_terms.detach().new_full(shape, -torch.inf)
    largest = largest.scatter_reduce(1, index, log_terms.detach(), "amax")
    largest = largest.where(torch.isfinite(largest), 0.0)
    terms = (log_terms - largest.gather(1, index)).exp()
    total = torch.zeros_like(largest).index_add(1, row, terms)
    return total.log() + largest
