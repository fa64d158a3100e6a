"""Tensors as bytes, and a table of what these bytes are."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["dtype_named", "memory_of", "packed", "unpacked"]


def memory_of(tensor: Tensor) -> np.ndarray:
    """Return the memory of a tensor on the CPU, which shares it with no other one."""
    storage = tensor.untyped_storage()
    return torch.empty(0, dtype=torch.uint8).set_(storage).numpy()  # type: ignore[call-overload]


def packed(tensors: Sequence[Tensor]) -> tuple[np.ndarray, list[list[Any]]]:
    """Return the memory of all tensors, one after the other, and a row for each.

    A row holds dtype, shape, strides and the number of bytes. The strides are kept
    because rounding depends on the order in memory.
    """
    parts = [memory_of(tensor) for tensor in tensors]
    rows = [
        [_name(tensor.dtype), list(tensor.shape), list(tensor.stride()), len(part)]
        for tensor, part in zip(tensors, parts, strict=True)
    ]
    return np.concatenate([np.empty(0, np.uint8), *parts]), rows


def unpacked(memory: np.ndarray, rows: Iterable[Sequence[Any]]) -> Iterator[Tensor]:
    """Yield the tensors again, each in memory of its own."""
    start = 0
    for name, shape, strides, num_bytes in rows:
        part = torch.from_numpy(memory[start : start + num_bytes].copy())
        storage = part.untyped_storage()
        empty = torch.empty(0, dtype=dtype_named(name))
        yield empty.set_(storage, 0, tuple(shape), tuple(strides))  # type: ignore[call-overload]
        start += num_bytes


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def dtype_named(name: str) -> torch.dtype:
    """Return a dtype of torch by its name."""
    found = getattr(torch, name)
    if not isinstance(found, torch.dtype):
        raise TypeError(f"expected the name of a dtype; got {name!r}")
    return found
