"""Checks of user input: the only place where messages about shapes are written.

Each check raises with the argument's name, what was expected, what came, and where
there is one, what to do next. Public functions call them once; private code trusts.
"""

from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.errors import InvalidInputError, InvalidTypeError, NotReadyError

__all__ = [
    "as_numbers",
    "as_shape",
    "check_batch",
    "check_choice",
    "check_device",
    "check_finite",
    "check_gradients",
    "check_in_support",
    "check_instance",
    "check_integer",
    "check_not_negative",
    "check_numbers",
    "check_positive",
    "check_prior",
    "check_rows",
    "check_same_length",
    "check_tensor",
    "check_theta",
    "check_unit_interval",
    "check_weights",
    "usable_device",
]

# What the sum of weights may be away from one, such as that of float32 numbers.
ROUNDING_OF_WEIGHTS = 1e-5


def check_tensor(name: str, value: Any) -> Tensor:
    """Return ``value`` if it is a tensor of numbers; say how to convert if not."""
    if not isinstance(value, Tensor):
        raise InvalidTypeError(
            f"Expected `{name}` to be a torch.Tensor; got {type(value).__name__}. "
            f"Convert it with `torch.as_tensor({name}, dtype=torch.float32)`."
        )
    if value.is_complex() or value.dtype == torch.bool:
        raise InvalidTypeError(
            f"Expected `{name}` to hold real numbers; got dtype {value.dtype}."
        )
    return value


def check_finite(name: str, value: Tensor) -> None:
    """Raise if any entry is NaN or infinite, naming the first rows that are."""
    bad = ~torch.isfinite(value)
    if bad.any():
        rows = bad.flatten(1).any(dim=1) if value.ndim > 1 else bad.reshape(-1)
        first = rows.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            f"Expected `{name}` to be finite; got NaN or Inf in {int(rows.sum())} of "
            f"{rows.numel()} rows (first: {first}). Remove or repair these rows."
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
    if finite:
        check_finite(name, value)
    return value


def check_device(name: str, value: Tensor, device: torch.device) -> None:
    """Raise unless a tensor lives on the device of the posterior."""
    if value.device != device:
        raise InvalidInputError(
            f"Expected `{name}` on {device}, where the posterior is; got "
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
    whole = rows.ndim == 1 and rows.dtype == torch.long
    if not whole or bool(((rows < 0) | (rows >= count)).any()):
        raise InvalidInputError(
            f"Expected `{name}` to be whole numbers of rows (int64), shape (m,), from "
            f"0 to {count - 1}; got {rows.dtype} of shape {tuple(rows.shape)}."
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
    if torch.isnan(theta).any():
        raise InvalidInputError("Expected `theta` without NaN.")
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
    outside = ~within_support(prior, theta)
    if outside.any():
        first = outside.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            f"Expected `{name}` inside the support of the prior; {int(outside.sum())} "
            f"of {theta.shape[0]} rows are outside (first: {first}). Check the units "
            f"and the order of the parameters, or train NPE with a wider prior."
        )


def check_positive(name: str, value: Any) -> None:
    """Raise unless ``value`` is a finite number above zero."""
    if not _is_number(value) or not 0.0 < value < float("inf"):
        raise InvalidInputError(f"Expected `{name}` to be positive; got {value!r}.")


def check_not_negative(name: str, value: Any) -> None:
    """Raise unless ``value`` is a finite number of at least zero."""
    if not _is_number(value) or not 0.0 <= value < float("inf"):
        raise InvalidInputError(
            f"Expected `{name}` to be a finite number of at least 0; got {value!r}."
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
            f"0.5]; got {value!r}."
        )
    return numbers


def check_integer(name: str, value: Any, *, minimum: int = 1) -> None:
    """Raise unless ``value`` is an integer of at least ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < minimum:
        raise InvalidInputError(
            f"Expected `{name}` to be an integer of at least {minimum}; got {value!r}."
        )


def check_unit_interval(name: str, value: Any) -> None:
    """Raise unless ``value`` is a number in [0, 1]."""
    if not _is_number(value) or not 0.0 <= value <= 1.0:
        raise InvalidInputError(f"Expected `{name}` in [0, 1]; got {value!r}.")


def check_weights(name: str, value: Any, count: int) -> list[float]:
    """Return so many numbers, if none is negative and they sum to one."""
    weights = torch.as_tensor(value, dtype=torch.double)
    if weights.shape != (count,):
        raise InvalidInputError(
            f"Expected `{name}` to be {count} numbers; got shape "
            f"{tuple(weights.shape)}."
        )
    total = float(weights.sum())
    if not (weights >= 0).all() or not abs(total - 1) < ROUNDING_OF_WEIGHTS:
        raise InvalidInputError(
            f"Expected `{name}` without negative numbers and with a sum of one; got "
            f"{weights.tolist()}, whose sum is {total:g}."
        )
    return weights.tolist()


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise unless ``value`` is one of the choices."""
    if value not in choices:
        raise InvalidInputError(
            f"Expected `{name}` to be one of {list(choices)}; got {value!r}."
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
