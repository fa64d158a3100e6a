"""How the baselines train their networks on rows of data."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from sbi_rope.fit import History, Training, epochs_on_pairs, fit, shuffled

__all__ = ["fit_rows"]


def fit_rows(
    network: nn.Module,
    loss: Callable[[Tensor], Tensor],
    split: tuple[Tensor, Tensor],
    training: Training,
    *,
    validation_loss: Callable[[Tensor], Tensor] | None = None,
    pairs: Tensor | None = None,
    **options: Any,
) -> History:
    """Train a network in place on the rows of a split.

    The mean loss is that of some rows, given their numbers. ``validation_loss`` takes
    the hold-out set, which may be empty, and is ``loss`` if None. Where too few pairs
    of parameters ``pairs`` leave none to hold out, it warns and makes few epochs. Other
    options are those of :func:`~sbi_rope.fit.fit`.
    """
    rows, held_out = split
    score = validation_loss or loss
    if pairs is not None:
        epochs = epochs_on_pairs(pairs, held_out, training.max_num_epochs)
        options["max_num_epochs"] = epochs
    [history] = fit(
        network,
        lambda epoch: zip(shuffled(rows, training.training_batch_size), strict=True),
        loss,
        training,
        validation_loss=(lambda: score(held_out)) if len(held_out) else None,
        **options,
    )
    return history
