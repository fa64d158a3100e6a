"""Checks of settings: numbers, choices, names, paths, devices and torch's own state."""

import math
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Rational, Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope._validation.tensors import DTYPES, check_tensor, check_values
from sbi_rope.errors import InvalidInputError, NotReadyError, shown

__all__ = [
    "LARGEST_SETTING",
    "as_shape",
    "check_choice",
    "check_default_dtype",
    "check_gradients",
    "check_instance",
    "check_integer",
    "check_level",
    "check_mapping",
    "check_names",
    "check_not_negative",
    "check_number",
    "check_numbers",
    "check_parameter_names",
    "check_path",
    "check_positive",
    "check_unit_interval",
    "check_weights",
    "default_names",
    "usable_device",
]

# How far the sum of weights may be from one. Weights in float32 do not sum to one
# exactly.
ROUNDING_OF_WEIGHTS = 1e-5
LARGEST_INTEGER = 2**63 - 1  # the largest that torch can hold
# The product of such a number with data of a usual size is still finite in float32.
LARGEST_SETTING = 1e30


def check_instance(
    name: str, value: Any, expected: type, *, optional: bool = False, hint: str = ""
) -> None:
    """Raise unless ``value`` is an instance of a class, or None where allowed.

    Args:
        name: What the argument is called.
        value: What the user gave.
        expected: The class.
        optional: Whether None is allowed.
        hint: A sentence that says how to make such an instance.
    """
    if not isinstance(value, expected) and not (optional and value is None):
        raise InvalidInputError(
            f"Expected `{name}` to be a {expected.__name__}; got "
            f"{type(value).__name__}.{hint and ' '}{hint}"
        )


def check_mapping(name: str, value: Any, *, like: str) -> None:
    """Raise unless ``value`` is a dictionary with at least one entry."""
    if not isinstance(value, Mapping):
        raise InvalidInputError(
            f"Expected `{name}` to be a dictionary of {like} by name; got "
            f"{type(value).__name__}."
        )
    if not value:
        raise InvalidInputError(f"Expected `{name}` with at least one entry; got none.")
    check_names(f"the keys of {name}", list(value))


def check_names(name: str, value: Any, count: int | None = None) -> list[str]:
    """Return a list of strings, of length ``count`` if that is given.

    A single string is refused, although it could be read as a list of letters.
    """
    try:
        names = None if isinstance(value, str | bytes | Mapping) else list(value)
    except TypeError:
        names = None
    if names is None or not all(isinstance(entry, str) for entry in names):
        raise InvalidInputError(
            f"Expected `{name}` to be a list of strings; got {shown(value)}."
        )
    if count is not None and len(names) != count:
        raise InvalidInputError(
            f"Expected `{name}` of length {count}; got {len(names)}."
        )
    return names


def check_parameter_names(value: Any, count: int) -> tuple[str, ...]:
    """Return ``count`` names of parameters, no two of which are equal."""
    names = check_names("parameter_names", value)
    if len(names) != count or len(set(names)) != count:
        raise InvalidInputError(
            f"Expected `parameter_names` to be {count} different names, one for each "
            f"parameter; got {shown(value)}."
        )
    return tuple(names)


def default_names(count: int) -> tuple[str, ...]:
    """Return the names of parameters that have none of their own.

    Example:
        >>> default_names(2)
        ('theta_1', 'theta_2')
    """
    return tuple(f"theta_{k + 1}" for k in range(count))


def check_path(name: str, value: Any, *, optional: bool = False) -> Path | None:
    """Return a path in which ``~`` is the home folder, or None where allowed."""
    if value is None and optional:
        return None
    if not isinstance(value, str | Path):
        alternative = " or None" if optional else ""
        raise InvalidInputError(
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


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise unless ``value`` is one of the choices."""
    if not any(_is_same(value, choice) for choice in choices):
        raise InvalidInputError(
            f"Expected `{name}` to be one of {list(choices)}; got {shown(value)}."
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


def check_unit_interval(name: str, value: Any) -> None:
    """Raise unless ``value`` is a number in [0, 1]."""
    if not _is_number(value) or not 0.0 <= value <= 1.0:
        raise InvalidInputError(f"Expected `{name}` in [0, 1]; got {shown(value)}.")


def check_level(name: str, value: Any) -> None:
    """Raise unless ``value`` is a number between 0 and 1, which it must not be."""
    if not _is_number(value) or not 0.0 < value < 1.0:
        raise InvalidInputError(
            f"Expected `{name}` above 0 and below 1, such as 0.9; got {shown(value)}."
        )


def check_integer(
    name: str, value: Any, *, minimum: int = 1, maximum: int | None = LARGEST_INTEGER
) -> None:
    """Raise unless ``value`` is an integer from ``minimum`` to ``maximum``.

    Args:
        name: What the argument is called.
        value: What the user gave.
        minimum: The smallest value that is accepted.
        maximum: The largest value that is accepted, by default the largest integer of
            torch; None accepts any.
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


def check_numbers(name: str, value: Any) -> list[float]:
    """Return a list of at least one finite number, from any container of numbers."""
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


def check_weights(name: str, value: Any, count: int) -> list[float]:
    """Return ``count`` weights in float64: numbers from zero on that sum to one.

    They may be in any container of numbers, and their gradients are dropped.
    """
    if isinstance(value, Tensor):
        check_values(name, check_tensor(name, value))
    weights = _as_double(name, value, count)
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


def as_shape(name: str, value: Any) -> torch.Size:
    """Return the shape of draws, from a tuple of integers of at least zero."""
    try:
        shape = torch.Size(value)
    except TypeError as error:
        raise InvalidInputError(
            f"Expected `{name}` to be a tuple of integers, such as (1000,); got "
            f"{value!r}."
        ) from error
    if any(size < 0 for size in shape):
        raise InvalidInputError(
            f"Expected `{name}` without negative sizes; got {tuple(shape)}."
        )
    return shape


def usable_device(device: Any) -> torch.device:
    """Return a device, or raise if torch cannot use it on this machine."""
    try:
        return torch.empty(0, device=device).device
    except Exception as error:  # torch raises many kinds of errors here
        raise InvalidInputError(
            "Expected `device` to be one that torch can use here, such as 'cpu'; got "
            f"{device!r}: {error}"
        ) from error


def check_default_dtype() -> None:
    """Raise unless torch's default dtype is float32, which sbi's networks need."""
    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        raise NotReadyError(
            f"sbi computes in float32, but torch's default dtype is {dtype}. Call "
            "`torch.set_default_dtype(torch.float32)`; data may have any dtype."
        )


def check_gradients() -> None:
    """Raise in torch's inference mode, in which nothing can be trained."""
    if torch.is_inference_mode_enabled():
        raise NotReadyError(
            "Training needs gradients, which torch.inference_mode() rules out. Leave "
            "the inference mode before you train."
        )


def _is_number(value: Any) -> bool:
    """Say whether a value is a finite number that tensors can be multiplied with."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    if isinstance(value, Rational) and not isinstance(value, Integral):
        return False  # torch cannot use Python's fractions
    try:
        return math.isfinite(float(value))
    except OverflowError:  # an integer of more than 300 digits
        return False


def _in_words(maximum: float) -> str:
    return "" if maximum == math.inf else f", at most {maximum:g}"


def _is_same(value: Any, choice: Any) -> bool:
    """Compare a value with a choice of the same kind.

    Only values of one kind are compared with `==`, which returns an array for an array.
    """
    if isinstance(choice, Integral) and not isinstance(choice, bool):
        kind: type = Integral
        if isinstance(value, bool):  # Python takes True for 1, but a user means True
            return False
    else:
        kind = type(choice)
    return isinstance(value, kind) and bool(value == choice)


def _as_double(name: str, value: Any, count: int) -> Tensor:
    """Return real numbers from any container in float64, without their gradients."""
    try:
        if torch.as_tensor(value).dtype in DTYPES:
            return torch.as_tensor(value, dtype=torch.double).detach()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pass  # torch raises these for whatever is no array of numbers
    raise InvalidInputError(
        f"Expected `{name}` to be {count} real numbers; got {shown(value)}."
    )
