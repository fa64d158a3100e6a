"""The one place where data of a user become tensors, and are checked."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError


def as_batch(
    name: str,
    value: Any,
    event_shape: Sequence[int] | None = None,
    *,
    rows: int | None = None,
    device: torch.device | None = None,
    names: Sequence[str] | None = None,
    finite: bool = True,
    empty: bool = False,
) -> Tensor:
    """Return a user's data as a tensor of shape ``(n, *event_shape)``.

    It has no gradients. A floating-point tensor keeps its dtype, and all else becomes
    float32. A tensor has to be on the ``device``, where arrays and lists are moved. A
    table with the columns ``names`` in another order is put in order. Unless they are
    None, the shape of a row and the number of rows are checked.
    """
    numbers = as_numbers(name, value, device=device, names=names)
    shape = tuple(numbers.shape)
    event = shape[1:] if event_shape is None else tuple(event_shape)
    if not shape or shape[1:] != event or rows not in (None, shape[0]):
        sizes = ", ".join(map(str, ("n" if rows is None else rows, *event)))
        raise InvalidInputError(
            f"Expected `{name}` of shape ({sizes}{'' if event else ','}); got {shape}."
            + (f" For a single row pass `{name}[None]`." if shape == event else "")
        )
    if not (empty or shape[0]) or 0 in shape[1:]:
        raise InvalidInputError(
            f"Expected `{name}` with at least one number; got shape {shape}."
        )
    if finite and not (usable := torch.isfinite(numbers)).all():
        raise InvalidInputError(
            f"Expected `{name}` to be finite; got NaN or Inf in {rows_with(~usable)}."
        )
    return numbers


def as_numbers(
    name: str,
    value: Any,
    *,
    device: torch.device | None = None,
    names: Sequence[str] | None = None,
) -> Tensor:
    """Return a user's data as a tensor of any shape, see :func:`as_batch`."""
    if names and sorted(names) == sorted(column_names(value) or ()):
        value = value[list(names)]
    if isinstance(value, Tensor) and not value.is_complex():
        if device not in (None, value.device):
            raise InvalidInputError(
                f"Expected `{name}` on {device}; got {value.device}."
            )
        value = value.detach()
        return value if value.is_floating_point() else value.float()
    try:
        array = np.ma.asarray(value)  # NumPy alone would use what is under the mask
        if np.ma.is_masked(array) and array.dtype.kind in "biuf":
            array = np.ma.filled(array.astype(np.float64), np.nan)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"its type is {array.dtype}")
        with np.errstate(over="ignore"):  # Inf is found as such
            return torch.from_numpy(np.array(array, np.float32)).to(device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInputError(
            f"Expected `{name}` to be a tensor, an array, a table or a list of "
            f"numbers; got {type(value).__name__} ({error})."
        ) from error


def column_names(value: Any) -> tuple[str, ...] | None:
    """Return the names of the columns of a table or of one of its rows, or None."""
    found = getattr(value, "columns", getattr(value, "index", ()))
    names = () if callable(found) else tuple(found)  # lists have a method `index`
    are_names = all(isinstance(name, str) for name in names)
    return names if names and are_names and len(set(names)) == len(names) else None


def divisors(std: Tensor) -> Tensor:
    """Return standard deviations, or variances, with one in the place of zero."""
    return std.where(std > 0, 1.0)


def rows_with(bad: Tensor) -> str:
    """Say in how many rows an entry is bad, and which are the first."""
    rows = bad.flatten(1).any(dim=1) if bad.ndim > 1 else bad.reshape(-1)
    first = rows.nonzero().flatten()[:5].tolist()
    return f"{int(rows.sum())} of {rows.numel()} rows (first: {first})"
