"""Networks built around the embedding net of a density estimator."""

import copy

from torch import Tensor, nn

from sbi_rope._sbi import embed

__all__ = ["embedding_with_head", "fresh_copy"]

# Units of the hidden layers where an estimator has no embedding net of its own.
HIDDEN = 64


def fresh_copy(module: nn.Module) -> nn.Module:
    """Copy a network and draw its parameters anew.

    That is, those of all modules with a ``reset_parameters``, as torch's have. What
    standardises keeps its constants.
    """
    module = copy.deepcopy(module).requires_grad_()
    # The outer ones last, whose own way to start overrules that of their parts.
    for part in reversed(list(module.modules())):
        if callable(getattr(part, "reset_parameters", None)):
            part.reset_parameters()  # type: ignore[operator]
    return module


def embedding_with_head(
    embedding: nn.Module, num_outputs: int, x: Tensor
) -> nn.Sequential:
    """Return a fresh embedding net followed by a linear layer.

    Where the embedding has no parameters, two hidden layers of 64 units stand between.

    Args:
        embedding: Maps observations ``(n, *event)`` to embeddings ``(n, l)``; is
            copied.
        num_outputs: Width of the last layer.
        x: Some observations, to learn the width of an embedding.
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
