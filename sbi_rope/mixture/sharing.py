"""Tensors of the same content, kept in memory once."""

import hashlib
from collections.abc import Hashable

from torch import Tensor, nn

from sbi_rope.saving.memory import memory_of

__all__ = ["share_equal_tensors"]


def share_equal_tensors(module: nn.Module) -> None:
    """Let all equal parameters and buffers inside a module be the same tensors.

    Copies of a network share what was not trained in each copy, and nets that are tuned
    from the same start differ from each other only if a step improved them. The module
    must not be trained afterwards: it would train shared parameters together.
    """
    known: dict[Hashable, Tensor] = {}
    for part in module.modules():
        for name, value in [
            *part.named_parameters(recurse=False),
            *part.named_buffers(recurse=False),
        ]:
            shared = known.setdefault(_content(value), value)
            if shared is not value:
                setattr(part, name, shared)


def _content(value: Tensor) -> Hashable:
    memory = memory_of(value.detach().cpu().clone())
    digest = hashlib.blake2b(memory.tobytes()).digest()
    kind = (type(value), value.requires_grad, value.dtype, value.device)
    return (*kind, value.shape, value.stride(), digest)
