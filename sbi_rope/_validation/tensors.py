"""Checks of tensors of data, and of the prior that parameters come from."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._validation.shapes import shape_hint
from sbi_rope.errors import InvalidInputError

__all__ = [
    "DTYPES",
    "as_array",
    "as_float32",
    "as_numbers",
    "as_numbers_on",
    "check_batch",
    "check_device",
    "check_finite",
    "check_groups",
    "check_in_support",
    "check_not_nan",
    "check_pair_weights",
    "check_prior",
    "check_readable",
    "check_rows",
    "check_same_length",
    "check_tensor",
    "check_theta",
    "check_values",
]

# A pair may count as so many. Larger factors are more than sums in float64 can hold.
LARGEST_WEIGHT = 1e6
# The dtypes of numbers that torch can compare and add. It can do too little with
# complex numbers, booleans, and quantised, eight-bit floating-point or wide unsigned
# numbers.
DTYPES = {
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    *(torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
}


def check_tensor(name: str, value: Any) -> Tensor:
    """Return ``value`` if it is a dense tensor of real numbers.

    Raises:
        InvalidInputError: If it is not. The message says how to convert it.
    """
    if not isinstance(value, Tensor):
        raise InvalidInputError(
            f"Expected `{name}` to be a torch.Tensor; got {type(value).__name__}. "
            f"Convert it with `torch.as_tensor({name}, dtype=torch.float32)`."
        )
    if value.dtype not in DTYPES:
        raise InvalidInputError(
            f"Expected `{name}` to hold real numbers; got dtype {value.dtype}."
        )
    if value.layout != torch.strided or value.is_nested:
        layout = "a nested tensor" if value.is_nested else f"layout {value.layout}"
        raise InvalidInputError(
            f"Expected `{name}` to be a dense tensor; got {layout}. Convert a sparse "
            f"one with `{name}.to_dense()`."
        )
    return value


def as_numbers(name: str, value: Any) -> Tensor:
    """Return ``value`` as a tensor of numbers; lists and arrays are converted.

    They are copied, in float64, which holds the numbers of all of them. What is masked
    becomes NaN.

    Raises:
        InvalidInputError: If it holds no real numbers, or its rows differ in length.
    """
    if isinstance(value, Tensor):
        return check_tensor(name, value)
    try:
        array = as_array(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInputError(_no_numbers(name, value)) from error
    if array.dtype.kind not in "iuf":
        raise InvalidInputError(_no_numbers(name, value))
    return torch.from_numpy(array.astype(np.float64))


def as_array(value: Any) -> np.ndarray:
    """Return ``value`` as an array; masked numbers become NaN.

    NumPy itself drops the mask, and would use what is under it.

    Example:
        >>> as_array(np.ma.masked_equal([[1, -9]], -9))
        array([[ 1., nan]])
    """
    array = np.ma.asarray(value)
    if np.ma.is_masked(array) and array.dtype.kind in "biuf":
        return np.ma.filled(array.astype(np.float64), np.nan)
    return array.data


def as_numbers_on(name: str, value: Any, device: torch.device) -> Tensor:
    """Return ``value`` as a tensor of numbers on a device.

    Lists and arrays, which have no device of their own, are moved there.

    Raises:
        InvalidInputError: As :func:`as_numbers`.
        InvalidInputError: If it is a tensor on another device.
    """
    numbers = as_numbers(name, value)
    if isinstance(value, Tensor):
        check_device(name, numbers, device)
        return numbers
    # Not every device holds float64.
    return numbers if device.type == "cpu" else numbers.float().to(device)


def as_float32(name: str, value: Tensor) -> Tensor:
    """Return a finite tensor as float32; raise if a number is too large for that."""
    converted = value.float()
    if converted is not value and value.dtype == torch.float64:
        large = value.abs() > torch.finfo(torch.float32).max
        if large.any():
            raise InvalidInputError(
                f"Expected `{name}` to have numbers that float32 holds, up to 3.4e38; "
                f"got larger ones in {_rows_with(large)}. Remove or repair these rows, "
                "or use other units."
            )
    return converted


def check_values(name: str, value: Tensor) -> None:
    """Raise if a tensor has a shape but no numbers, as on torch's device ``meta``."""
    if value.is_meta:
        raise InvalidInputError(
            f"Expected `{name}` to hold numbers; got a tensor on the device 'meta', "
            "which has a shape only."
        )


def check_finite(name: str, value: Tensor) -> None:
    """Raise if an entry is NaN or infinite; the message lists the first such rows."""
    check_values(name, value)
    bad = ~torch.isfinite(value)
    if bad.any():
        raise InvalidInputError(
            f"Expected `{name}` to be finite; got NaN or Inf in {_rows_with(bad)}. "
            "Remove or repair these rows."
        )


def check_readable(name: str, value: Tensor, can_read: Tensor) -> None:
    """Raise if there are observations that the embedding net cannot read.

    Args:
        name: What the argument is called.
        value: Observations, shape ``(n, *event)``.
        can_read: Which of them can be read, shape ``(n,)``.
    """
    if can_read.all():
        return
    rows, unread = value.flatten(1), ~can_read
    infinite = unread & torch.isinf(rows).any(dim=1)
    empty = unread & torch.isnan(rows).all(dim=1)
    causes = (
        (infinite, "to be finite; got Inf", ""),
        (
            empty,
            "with a number in each row; got NaN only",
            " If x is a set of trials, all of them are missing there.",
        ),
        (
            unread & ~infinite & ~empty,
            "to be finite; got NaN",
            " NaN may stand for missing trials or readings if the embedding net leaves "
            "them out, as sbi's PermutationInvariantEmbedding does. This net does not.",
        ),
    )
    raise InvalidInputError(
        " ".join(
            f"Expected `{name}` {what} in {_rows_with(found)}. Remove or repair these "
            f"rows.{hint}"
            for found, what, hint in causes
            if found.any()
        )
    )


def check_not_nan(name: str, value: Tensor) -> None:
    """Raise if an entry is NaN. Infinite entries can be compared and are allowed."""
    check_values(name, value)
    count = int(torch.isnan(value).sum())
    if count:
        raise InvalidInputError(
            f"Expected `{name}` without NaN; got {count} among {value.numel()} numbers."
        )


def check_batch(
    name: str,
    value: Any,
    event_shape: Sequence[int],
    *,
    finite: bool = True,
    allow_empty: bool = False,
    reads_missing: bool = False,
) -> Tensor:
    """Return ``value`` if it is a batch of events, shape ``(n, *event_shape)``.

    Args:
        name: What the argument is called.
        value: What the user gave.
        event_shape: The shape of one event.
        finite: Whether NaN and infinite entries are refused.
        allow_empty: Whether n may be 0.
        reads_missing: Whether missing trials (NaN) can be read, for a hint.

    Raises:
        InvalidInputError: If it is no tensor of real numbers.
        InvalidInputError: If the shape does not fit, an event holds no number, or an
            entry is not finite.
    """
    value = check_tensor(name, value)
    sizes = ", ".join(str(size) for size in event_shape)
    expected = f"(n, {sizes})" if sizes else "(n,)"
    if tuple(value.shape[1:]) != tuple(event_shape) or value.ndim == 0:
        raise InvalidInputError(
            f"Expected `{name}` of shape {expected}; got {tuple(value.shape)}."
            + shape_hint(name, value.shape, event_shape, reads_missing=reads_missing)
        )
    if value.shape[0] == 0 and not allow_empty:
        raise InvalidInputError(
            f"Expected `{name}` of shape {expected} with n >= 1; got an empty batch."
        )
    if 0 in event_shape:
        raise InvalidInputError(
            f"Expected `{name}` with at least one number in each row; got shape "
            f"{tuple(value.shape)}."
        )
    if finite:
        check_finite(name, value)
    return value


def check_device(
    name: str, value: Tensor, device: torch.device, *, where: str = "the posterior"
) -> None:
    """Raise unless a tensor is on a device; ``where`` names what else is there."""
    if value.device != device:
        raise InvalidInputError(
            f"Expected `{name}` on {device}, where {where} is; got "
            f"{value.device}. Move it with `{name}.to('{device}')`."
        )


def check_pair_weights(
    weights: Tensor, name: str, rows: Tensor, *, weights_name: str = "weights"
) -> Tensor:
    """Return how many pairs each row counts as, shape ``(n,)``."""
    weights = check_batch(weights_name, weights, ())
    check_same_length(name, rows, weights_name, weights)
    if not bool((weights > 0).all()):
        raise InvalidInputError(
            f"Expected positive `{weights_name}`; got {float(weights.min())}. Leave "
            "out pairs that should not count."
        )
    if bool((weights > LARGEST_WEIGHT).any()):
        raise InvalidInputError(
            f"Expected `{weights_name}`, each the number of pairs that a pair counts "
            f"as, of at most {LARGEST_WEIGHT:g}; got {float(weights.max()):g}. Divide "
            "all by the same number."
        )
    return weights


def check_groups(groups: Tensor, name: str, rows: Tensor) -> Tensor:
    """Return numbers of groups, one for each row, shape ``(n,)``."""
    groups = check_tensor("groups", groups)
    if groups.ndim != 1:
        raise InvalidInputError(
            "Expected `groups` with one number for each pair, shape (n,); got "
            f"{tuple(groups.shape)}."
        )
    check_finite("groups", groups)
    check_same_length(name, rows, "groups", groups)
    return groups


def check_same_length(name_a: str, a: Tensor, name_b: str, b: Tensor) -> None:
    """Raise if two batches have different numbers of rows."""
    if a.shape[0] != b.shape[0]:
        raise InvalidInputError(
            f"Expected `{name_a}` and `{name_b}` to have the same number of rows; got "
            f"{a.shape[0]} and {b.shape[0]}."
        )


def check_rows(name: str, value: Any, count: int) -> Tensor:
    """Return indices of rows, shape ``(m,)``, if all are from 0 to ``count`` - 1."""
    rows = check_tensor(name, value)
    check_values(name, rows)
    whole = rows.ndim == 1 and rows.dtype == torch.long
    if not whole or bool(((rows < 0) | (rows >= count)).any()):
        got = f"{rows.dtype} of shape {tuple(rows.shape)}"
        if rows.ndim == 1 and len(rows):
            got += f" with numbers from {rows.min()} to {rows.max()}"
        raise InvalidInputError(
            f"Expected `{name}` to be whole numbers of rows (int64), shape (m,), from "
            f"0 to {count - 1}; got {got}."
        )
    return rows


def check_theta(theta: Any, event_shape: torch.Size, *, batched: bool) -> Tensor:
    """Return the parameters whose density is asked for, as a tensor of float32.

    Args:
        theta: What the user gave. A bound of the prior is one in float32 only: 0.1 of
            float64 is below the 0.1 of a prior.
        event_shape: Shape of one theta, ``(d,)``.
        batched: Whether theta belongs to a batch of B observations. Its shape is then
            ``(B, d)``, or ``(S, B, d)`` for S parameters of each observation. Otherwise
            it is ``(n, d)`` or ``(d,)``.

    Raises:
        InvalidInputError: If the shape does not fit, there is no parameter, or one is
            NaN.
    """
    theta, dim = as_numbers("theta", theta), event_shape[0]
    expected = f"(B, {dim}) or (S, B, {dim})" if batched else f"(n, {dim})"
    ndims = (2, 3) if batched else (1, 2)
    if theta.ndim not in ndims or theta.shape[-1:] != event_shape:
        raise InvalidInputError(
            f"Expected `theta` of shape {expected}; got {tuple(theta.shape)}."
            + shape_hint("theta", theta.shape, event_shape)
        )
    if not theta.numel():
        raise InvalidInputError(
            f"Expected at least one `theta`; got shape {tuple(theta.shape)}."
        )
    check_not_nan("theta", theta)
    return theta.to(torch.float32)


def check_prior(prior: Any) -> None:
    """Raise unless the prior is a torch distribution over vectors."""
    if not isinstance(prior, Distribution):
        raise InvalidInputError(
            f"Expected `prior` to be a torch distribution; got "
            f"{type(prior).__name__}. Wrap it with "
            f"`sbi.utils.process_prior(prior)[0]`."
        )
    if len(prior.event_shape) != 1:
        raise InvalidInputError(
            "Expected a `prior` over vectors, event shape (d,); got event shape "
            f"{tuple(prior.event_shape)}. Wrap several in "
            "`sbi.utils.MultipleIndependent`, or torch's own in "
            "`torch.distributions.Independent(prior, 1)`."
        )


def check_in_support(
    name: str,
    theta: Tensor,
    prior: Any,
    *,
    rows: Tensor | None = None,
    instead: str = "",
) -> None:
    """Raise if any row of ``theta`` lies outside the prior's support.

    Args:
        name: What the user calls it.
        theta: Parameters, shape ``(n, d)``.
        prior: The prior.
        rows: Which rows are checked, shape ``(n,)``; all if None.
        instead: What else the caller can do, as a sentence.
    """
    if not len(theta):  # sbi cannot check an empty batch
        return
    if rows is None:
        outside = ~within_support(prior, theta)
    else:
        outside = torch.zeros_like(rows)
        if rows.any():
            outside[rows] = ~within_support(prior, theta[rows])
    if outside.any():
        first = outside.nonzero().flatten()[:5].tolist()
        message = (
            f"Expected `{name}` inside the support of the prior; {int(outside.sum())} "
            f"of {theta.shape[0]} rows are outside (first: {first}). Check the units "
            "and the order of the parameters, or train NPE with a wider prior. "
            f"{instead}"
        )
        raise InvalidInputError(message.rstrip())


def _no_numbers(name: str, value: Any) -> str:
    """Say why something cannot be converted to a tensor."""
    message = (
        f"Expected `{name}` to be a tensor, an array or a list of numbers; got "
        f"{type(value).__name__}"
    )
    if len(lengths := _lengths(value)) > 1:
        return (
            f"{message} with rows of {min(lengths)} to {max(lengths)} entries. If "
            "these are sets of trials, pad them with NaN to the longest. An embedding "
            "net can read that if it leaves NaN out, as sbi's "
            "PermutationInvariantEmbedding does."
        )
    if columns := _columns_without_numbers(value):
        return (
            f"{message} whose column(s) {', '.join(columns)} cannot be read as plain "
            "numbers. Leave these columns out, or convert them with "
            '`astype("float64")`, which makes missing values NaN.'
        )
    return (
        f"{message} that holds something else. If these are numbers that were stored "
        'with other things, convert them with `astype("float64")`.'
    )


def _columns_without_numbers(value: Any) -> list[str]:
    """Return the columns of a dataframe of pandas that are no arrays of numbers."""
    if not hasattr(value, "columns") or not hasattr(value, "dtypes"):
        return []
    return [
        f"'{column}' ({dtype})"
        for column, dtype in zip(value.columns, value.dtypes, strict=True)
        if getattr(dtype, "kind", "O") not in "iuf" or not isinstance(dtype, np.dtype)
    ]


def _lengths(value: Any) -> set[int]:
    """Return the lengths of the rows of a list or an array of them."""
    if not isinstance(value, list | tuple | np.ndarray):
        return set()
    rows = (row for row in value if isinstance(row, list | tuple | np.ndarray | Tensor))
    return {len(row) for row in rows if getattr(row, "ndim", 1)}


def _rows_with(bad: Tensor) -> str:
    """Say in how many rows an entry is bad, and which are the first."""
    rows = bad.flatten(1).any(dim=1) if bad.ndim > 1 else bad.reshape(-1)
    first = rows.nonzero().flatten()[:5].tolist()
    return f"{int(rows.sum())} of {rows.numel()} rows (first: {first})"
