"""Fine-tuning on the pairs of a fold, a net without each part of them."""

import copy
import math
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.stacking.folds import Fold

__all__ = ["finetune_without"]

# Chosen on calibration data, see benchmarks/README.md.
BATCH_SIZE = 100
MAX_NUM_EPOCHS = 500
PATIENCE = 50
CLIP_MAX_NORM = 5.0


def finetune_without(start: Any, fold: Fold, part: int, *, learning_rate: float) -> Any:
    r"""Train an estimator on the pairs of a fold, but for one part that is held out.

    .. math::
        \min_q \; \sum_{i \notin \text{part}} -\log q(\theta_i \mid x_i)
        \quad\text{until}\quad \sum_{i \in \text{part}} -\log q(\theta_i \mid x_i)
        \quad\text{does not fall any more}

    All parameters are trained in evaluation mode, and the best epoch on the part is
    kept, the start included. The nets that a fold gets without each of its parts are
    mixed: what one of them learned by heart the others contradict.

    Args:
        start: An estimator of sbi with a density; it is left as it is.
        fold: What may be learned from.
        part: The number of the part to hold out, one of ``fold.used``.
        learning_rate: Of Adam.

    Returns:
        The trained estimator, in evaluation mode.
    """
    bench = fold.bench
    train, held_out = bench.rows_of(fold.used - {part}), bench.folds[part]
    estimator = copy.deepcopy(start).requires_grad_().eval()
    optimizer = torch.optim.Adam(estimator.parameters(), lr=learning_rate)
    order = torch.Generator().manual_seed(fold.seed)

    def loss(rows: Tensor) -> Tensor:
        return estimator.loss(bench.theta[rows], condition=bench.x[rows]).mean()

    best_loss, best_epoch = math.inf, 0
    best_state = copy.deepcopy(estimator.state_dict())
    for epoch in range(MAX_NUM_EPOCHS + 1):
        with torch.no_grad():
            newest = float(loss(held_out))
        # No NaN is better than anything.
        if newest < best_loss:
            best_loss, best_epoch = newest, epoch
            best_state = copy.deepcopy(estimator.state_dict())
        if epoch - best_epoch >= PATIENCE:
            break
        shuffled = train[torch.randperm(len(train), generator=order).to(train.device)]
        for rows in shuffled.split(BATCH_SIZE):
            optimizer.zero_grad()
            loss(rows).backward()
            nn.utils.clip_grad_norm_(estimator.parameters(), CLIP_MAX_NORM)
            optimizer.step()
    estimator.load_state_dict(best_state)
    return estimator.requires_grad_(requires_grad=False)
