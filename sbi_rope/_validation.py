"""Checks of user input: the only place where messages about shapes are written.

Each check raises with the argument's name, what was expected, what came, and where
there is one, what to do next. Public functions call them once; private code trusts.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Rational, Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.errors import InvalidInputError, InvalidTypeError, NotReadyError, shown

__all__ = [
    "LARGEST_SETTING",
    "as_float32",
    "as_numbers",
    "as_shape",
    "check_batch",
    "check_choice",
    "check_default_dtype",
    "check_device",
    "check_finite",
    "check_gradients",
    "check_in_support",
    "check_instance",
    "check_integer",
    "check_mapping",
    "check_names",
    "check_not_nan",
    "check_not_negative",
    "check_number",
    "check_numbers",
    "check_path",
    "check_positive",
    "check_prior",
    "check_rows",
    "check_same_length",
    "check_tensor",
    "check_theta",
    "check_unit_interval",
    "check_values",
    "check_weights",
    "usable_device",
]

# What the sum of weights may be away from one, such as that of float32 numbers.
ROUNDING_OF_WEIGHTS = 1e-5
# Those that torch can compare and add. Of complex numbers, booleans, quantised,
# eight-bit floating-point and wide unsigned ones, it can do too little.
DTYPES = {
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    *(torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
}
LARGEST_INTEGER = 2**63 - 1  # that torch can hold
# Products of such a number with data of a usual size stay finite in float32.
LARGEST_SETTING = 1e30


def check_tensor(name: str, value: Any) -> Tensor:
    """Return ``value`` if it is a tensor of numbers; say how to convert if not."""
    if not isinstance(value, Tensor):
        raise InvalidTypeError(
            f"Expected `{name}` to be a torch.Tensor; got {type(value).__name__}. "
            f"Convert it with `torch.as_tensor({name}, dtype=torch.float32)`."
        )
    if value.dtype not in DTYPES:
        raise InvalidTypeError(
            f"Expected `{name}` to hold real numbers; got dtype {value.dtype}."
        )
    if value.layout != torch.strided or value.is_nested:
        layout = "a nested tensor" if value.is_nested else f"layout {value.layout}"
        raise InvalidTypeError(
            f"Expected `{name}` to be a dense tensor; got {layout}. Convert a sparse "
            f"one with `{name}.to_dense()`."
        )
    return value


def as_float32(name: str, value: Tensor) -> Tensor:
    """Return a finite tensor as float32, or raise if that has no such numbers."""
    converted = value.float()
    if converted is not value and value.dtype == torch.float64:
        large = value.abs() > torch.finfo(torch.float32).max
        if large.any():
            rows = large.flatten(1).any(dim=1) if value.ndim > 1 else large.reshape(-1)
            first = rows.nonzero().flatten()[:5].tolist()
            raise InvalidInputError(
                f"Expected `{name}` to have numbers that float32 holds, up to 3.4e38; "
                f"got larger ones in {int(rows.sum())} of {rows.numel()} rows (first: "
                f"{first}). Remove or repair these rows, or use other units."
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
    """Raise if any entry is NaN or infinite, naming the first rows that are."""
    check_values(name, value)
    bad = ~torch.isfinite(value)
    if bad.any():
        rows = bad.flatten(1).any(dim=1) if value.ndim > 1 else bad.reshape(-1)
        first = rows.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            f"Expected `{name}` to be finite; got NaN or Inf in {int(rows.sum())} of "
            f"{rows.numel()} rows (first: {first}). Remove or repair these rows."
        )


def check_not_nan(name: str, value: Tensor) -> None:
    """Raise if any entry is NaN; infinite ones can still be compared."""
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
) -> Tensor:
    """Check a batch of events, shape ``(n, *event_shape)``, not empty by default."""
    value = check_tensor(name, value)
    expected = "(n, " + ", ".join(str(size) for size in event_shape) + ")"
    if tuple(value.shape[1:]) != tuple(event_shape) or value.ndim == 0:
        raise InvalidInputError(
            f"Expected `{name}` of shape {expected}; got {tuple(value.shape)}."
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
    """Raise unless a tensor lives on the device of the posterior, or what is named."""
    if value.device != device:
        raise InvalidInputError(
            f"Expected `{name}` on {device}, where {where} is; got "
            f"{value.device}. Move it with `{name}.to('{device}')`."
        )


def usable_device(device: Any) -> torch.device:
    """Return a device, if there is such a one here."""
    try:
        return torch.empty(0, device=device).device
    except Exception as error:  # torch raises all kinds
        raise InvalidInputError(
            "Expected `device` to be one that torch can use here, such as 'cpu'; got "
            f"{device!r}: {error}"
        ) from error


def check_default_dtype() -> None:
    """Raise where torch makes numbers that sbi's networks cannot take."""
    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        raise NotReadyError(
            f"sbi computes in float32, but torch's default dtype is {dtype}. Call "
            "`torch.set_default_dtype(torch.float32)`; data may have any dtype."
        )


def check_gradients() -> None:
    """Raise where torch cannot train anything."""
    if torch.is_inference_mode_enabled():
        raise NotReadyError(
            "Training needs gradients, which torch.inference_mode() rules out. Leave "
            "it for the training."
        )


def check_instance(
    name: str, value: Any, expected: type, *, optional: bool = False
) -> None:
    """Raise unless ``value`` is an instance of a class, or None where allowed."""
    if not isinstance(value, expected) and not (optional and value is None):
        raise InvalidTypeError(
            f"Expected `{name}` to be a {expected.__name__}; got "
            f"{type(value).__name__}."
        )


def check_mapping(name: str, value: Any, *, like: str) -> None:
    """Raise unless ``value`` is a dictionary with at least one entry."""
    if not isinstance(value, Mapping):
        raise InvalidTypeError(
            f"Expected `{name}` to be a dictionary of {like} by name; got "
            f"{type(value).__name__}."
        )
    if not value:
        raise InvalidInputError(f"Expected `{name}` with at least one entry; got none.")
    check_names(f"the keys of {name}", list(value))


def check_names(name: str, value: Any, count: int | None = None) -> list[str]:
    """Return so many names; one string is not taken for a name a letter."""
    try:
        names = None if isinstance(value, str | bytes | Mapping) else list(value)
    except TypeError:
        names = None
    if names is None or not all(isinstance(entry, str) for entry in names):
        raise InvalidTypeError(
            f"Expected `{name}` to be a list of strings; got {shown(value)}."
        )
    if count is not None and len(names) != count:
        raise InvalidInputError(
            f"Expected `{name}` of length {count}; got {len(names)}."
        )
    return names


def check_path(name: str, value: Any, *, optional: bool = False) -> Path | None:
    """Return a path with the home folder filled in; None where that is allowed."""
    if value is None and optional:
        return None
    if not isinstance(value, str | Path):
        alternative = " or None" if optional else ""
        raise InvalidTypeError(
            f"Expected `{name}` to be a path{alternative}; got {type(value).__name__}."
        )
    if "\0" in str(value):
        raise InvalidInputError(
            f"Expected `{name}` to be a path; got {shown(value)}, with a null byte."
        )
    try:
        return Path(value).expanduser()
    except RuntimeError as error:  # no such user
        raise InvalidInputError(f"Expected `{name}` to be a path; {error}") from error


def check_prior(prior: Any) -> None:
    """Raise unless the prior is a torch distribution over vectors."""
    if not isinstance(prior, Distribution):
        raise InvalidTypeError(
            f"Expected `prior` to be a torch distribution; got "
            f"{type(prior).__name__}. Wrap it with "
            f"`sbi.utils.process_prior(prior)[0]`."
        )
    if len(prior.event_shape) != 1:
        raise InvalidInputError(
            "Expected a `prior` over vectors, event shape (k,); got event shape "
            f"{tuple(prior.event_shape)}. Wrap several in "
            "`sbi.utils.MultipleIndependent`, or torch's own in "
            "`torch.distributions.Independent(prior, 1)`."
        )


def check_same_length(name_a: str, a: Tensor, name_b: str, b: Tensor) -> None:
    """Raise if two batches have different numbers of rows."""
    if a.shape[0] != b.shape[0]:
        raise InvalidInputError(
            f"Expected `{name_a}` and `{name_b}` to have the same number of rows; got "
            f"{a.shape[0]} and {b.shape[0]}."
        )


def check_rows(name: str, value: Any, count: int) -> Tensor:
    """Return numbers of rows, shape ``(m,)``, from 0 to ``count`` - 1."""
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


def as_numbers(name: str, value: Any) -> Tensor:
    """Return a tensor of numbers, made from whatever holds some."""
    if not isinstance(value, Tensor):
        try:
            value = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidTypeError(
                f"Expected `{name}` to be a tensor of numbers, or what torch makes one "
                f"of; got {type(value).__name__}."
            ) from error
    return check_tensor(name, value)


def check_theta(theta: Any, event_shape: torch.Size, *, batched: bool) -> Tensor:
    """Return parameters whose density is asked for.

    Args:
        theta: What the user gave.
        event_shape: Shape of one theta, ``(d,)``.
        batched: Whether there is one theta for each of B observations, shape ``(B,
            d)``, or several, ``(S, B, d)``; otherwise it is ``(n, d)`` or ``(d,)``.

    Raises:
        InvalidInputError: If the shape does not fit, there is none, or one is NaN.
    """
    theta, dim = as_numbers("theta", theta), event_shape[0]
    expected = f"(B, {dim}) or (S, B, {dim})" if batched else f"(n, {dim})"
    ndims = (2, 3) if batched else (1, 2)
    if theta.ndim not in ndims or theta.shape[-1:] != event_shape:
        raise InvalidInputError(
            f"Expected `theta` of shape {expected}; got {tuple(theta.shape)}."
        )
    if not theta.numel():
        raise InvalidInputError(
            f"Expected at least one `theta`; got shape {tuple(theta.shape)}."
        )
    check_not_nan("theta", theta)
    return theta


def as_shape(name: str, value: Any) -> torch.Size:
    """Return the shape of draws, from a tuple of integers."""
    try:
        shape = torch.Size(value)
    except TypeError as error:
        raise InvalidTypeError(
            f"Expected `{name}` to be a tuple of integers, such as (1000,); got "
            f"{value!r}."
        ) from error
    if any(size < 0 for size in shape):
        raise InvalidInputError(
            f"Expected `{name}` without negative sizes; got {tuple(shape)}."
        )
    return shape


def check_in_support(name: str, theta: Tensor, prior: Any) -> None:
    """Raise if any row of ``theta`` lies outside the prior's support."""
    if not len(theta):  # about which sbi cannot tell
        return
    outside = ~within_support(prior, theta)
    if outside.any():
        first = outside.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            f"Expected `{name}` inside the support of the prior; {int(outside.sum())} "
            f"of {theta.shape[0]} rows are outside (first: {first}). Check the units "
            f"and the order of the parameters, or train NPE with a wider prior."
        )


def check_number(name: str, value: Any, *, maximum: float = math.inf) -> None:
    """Raise unless ``value`` is a finite number, of at most ``maximum`` in size."""
    if not _is_number(value) or not abs(value) <= maximum:
        raise InvalidInputError(
            f"Expected `{name}` to be a finite number{_in_words(maximum)}; got "
            f"{shown(value)}."
        )


def check_positive(name: str, value: Any, *, maximum: float = math.inf) -> None:
    """Raise unless ``value`` is a finite number above zero, at most ``maximum``."""
    if not _is_number(value) or not 0.0 < value <= maximum:
        raise InvalidInputError(
            f"Expected `{name}` to be positive{_in_words(maximum)}; got {shown(value)}."
        )


def check_not_negative(name: str, value: Any, *, maximum: float = math.inf) -> None:
    """Raise unless ``value`` is a finite number from zero to ``maximum``."""
    if not _is_number(value) or not 0.0 <= value <= maximum:
        raise InvalidInputError(
            f"Expected `{name}` to be a finite number of at least 0"
            f"{_in_words(maximum)}; got {shown(value)}."
        )


def check_numbers(name: str, value: Any) -> list[float]:
    """Return a list of at least one number, from anything that holds some."""
    if isinstance(value, Tensor | np.ndarray):
        value = value.tolist()
    numbers = None
    if isinstance(value, Iterable) and not isinstance(value, str):
        numbers = list(value)
    if not numbers or not all(_is_number(number) for number in numbers):
        raise InvalidInputError(
            f"Expected `{name}` to be a list of at least one number, such as [0.1, "
            f"0.5]; got {shown(value)}."
        )
    return numbers


def check_integer(
    name: str, value: Any, *, minimum: int = 1, maximum: int | None = LARGEST_INTEGER
) -> None:
    """Raise unless ``value`` is an integer of at least ``minimum``, and not too large.

    Args:
        name: What the value is called.
        value: What came.
        minimum: The smallest value that is accepted.
        maximum: The largest; unless given, what torch can hold. None for any.
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    too_large = is_integer and maximum is not None and int(value) > maximum
    if not is_integer or int(value) < minimum or too_large:
        bounds = f"of at least {minimum}"
        if too_large or maximum not in (None, LARGEST_INTEGER):
            bounds = f"from {minimum} to {maximum}"
        raise InvalidInputError(
            f"Expected `{name}` to be an integer {bounds}; got {shown(value)}."
        )


def check_unit_interval(name: str, value: Any) -> None:
    """Raise unless ``value`` is a number in [0, 1]."""
    if not _is_number(value) or not 0.0 <= value <= 1.0:
        raise InvalidInputError(f"Expected `{name}` in [0, 1]; got {shown(value)}.")


def check_weights(name: str, value: Any, count: int) -> list[float]:
    """Return so many numbers, if none is negative and they sum to one."""
    if isinstance(value, Tensor):
        check_values(name, check_tensor(name, value))
    weights = _as_numbers(name, value, count)
    if weights.shape != (count,):
        raise InvalidInputError(
            f"Expected `{name}` to be {count} numbers; got shape "
            f"{tuple(weights.shape)}."
        )
    total = float(weights.sum())
    if not (weights >= 0).all() or not abs(total - 1) < ROUNDING_OF_WEIGHTS:
        raise InvalidInputError(
            f"Expected `{name}` without negative numbers and with a sum of one; got "
            f"{shown(weights.tolist())}, whose sum is {total:g}."
        )
    return weights.tolist()


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise unless ``value`` is one of the choices."""
    if not any(_is_same(value, choice) for choice in choices):
        raise InvalidInputError(
            f"Expected `{name}` to be one of {list(choices)}; got {shown(value)}."
        )


def _is_number(value: Any) -> bool:
    """Whether a value is a number that tensors can be multiplied with, and finite."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    if isinstance(value, Rational) and not isinstance(value, Integral):
        return False  # torch knows no fractions
    try:
        return math.isfinite(float(value))
    except OverflowError:  # an integer of more than 300 digits
        return False


def _in_words(maximum: float) -> str:
    return "" if maximum == math.inf else f", at most {maximum:g}"


def _is_same(value: Any, choice: Any) -> bool:
    """Compare values of one kind only: arrays answer `==` with arrays."""
    if isinstance(choice, Integral) and not isinstance(choice, bool):
        kind: type = Integral
        if isinstance(value, bool):  # True is 1 to Python, not to a reader
            return False
    else:
        kind = type(choice)
    return isinstance(value, kind) and bool(value == choice)


def _as_numbers(name: str, value: Any, count: int) -> Tensor:
    """Return real numbers of any container in float64, without their gradients."""
    try:
        if torch.as_tensor(value).dtype in DTYPES:
            return torch.as_tensor(value, dtype=torch.double).detach()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pass  # what torch raises for all that is no array of numbers
    raise InvalidTypeError(
        f"Expected `{name}` to be {count} real numbers; got {shown(value)}."
    )
