"""Networks around an embedding net, and how the baselines train on rows of data."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.data.pairs import epochs_on_pairs
from sbi_rope.npe.sbi import embed
from sbi_rope.training.fit import History, Training, fit

# Units of the hidden layers where an estimator has no embedding net of its own.
HIDDEN = 64


def fresh_copy(module: nn.Module) -> nn.Module:
    """Copy a network and draw its parameters anew; standardisations stay."""
    module = copy.deepcopy(module).requires_grad_()
    # The outer ones last, whose own way to start overrules that of their parts.
    for part in reversed(list(module.modules())):
        if callable(getattr(part, "reset_parameters", None)):
            part.reset_parameters()  # type: ignore[operator]
    return module


def embedding_with_head(
    embedding: nn.Module, num_outputs: int, x: Tensor
) -> nn.Sequential:
    """Return a fresh embedding net of observations x, followed by a linear layer.

    Where the embedding has no parameters, two hidden layers of 64 units stand between.
    """
    embedding = fresh_copy(embedding)
    width = embed(embedding, x[:1]).flatten(1).shape[1]
    layers: list[nn.Module] = []
    if not any(True for _ in embedding.parameters()):
        for before in (width, HIDDEN):
            layers += [nn.Linear(before, HIDDEN), nn.ReLU()]
        width = HIDDEN
    return nn.Sequential(
        embedding, nn.Flatten(), *layers, nn.Linear(width, num_outputs)
    )


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

    The mean loss is that of some rows, given their numbers; ``validation_loss`` is the
    same if None. Where too few pairs of parameters ``pairs`` leave none to hold out, it
    warns and makes few epochs. Other options are those of ``fit``.
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


def shuffled(rows: Tensor, size: int) -> Iterator[Tensor]:
    """Pass over rows in random order, in batches of a size."""
    yield from rows[torch.randperm(len(rows)).to(rows.device)].split(size)
