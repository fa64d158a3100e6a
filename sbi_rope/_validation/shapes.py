"""Hints for batches whose shape does not fit: what to do to make it fit."""

import math
from collections.abc import Sequence
from typing import Any

from sbi_rope.errors import InvalidInputError

__all__ = ["check_not_swapped", "shape_hint"]


def shape_hint(
    name: str,
    shape: Sequence[int],
    event_shape: Sequence[int],
    *,
    reads_missing: bool = False,
) -> str:
    """Say how to change a batch so that it fits; nothing if that is not known.

    Args:
        name: What the argument is called.
        shape: The shape of what the user gave.
        event_shape: The shape of one event.
        reads_missing: Whether missing trials (NaN) can be read.
    """
    shape, event = tuple(shape), tuple(event_shape)
    if shape == event:
        return f" For a single one pass `{name}[None]`."
    if len(shape) == 1 and event == (1,):
        return f" For one number in each row pass `{name}[:, None]`."
    if event == (1, *shape[1:]) and len(event) > 1:
        return f" For one channel pass `{name}[:, None]`."
    if len(event) > 2 and shape[1:] == (*event[1:], event[0]):
        return f" The channels come first: pass `{name}.movedim(-1, 1)`."
    if len(shape) > 1 and math.prod(shape[1:]) == math.prod(event):
        sizes = ", ".join(str(size) for size in event)
        return (
            " The number of entries fits. If their order does too, pass "
            f"`{name}.reshape(-1, {sizes})`."
        )
    if len(event) == 2 and len(shape) == 3 and shape[2] == event[1]:
        return _hint_on_trials(shape[1], event[0], reads_missing=reads_missing)
    return ""


def _hint_on_trials(count: int, expected: int, *, reads_missing: bool) -> str:
    if not reads_missing:
        return " The embedding net reads sets of one number of trials only."
    if count < expected:
        return f" Pad with NaN to {expected} trials, which stands for missing trials."
    return (
        f" NPE was trained on {expected} trials. Leave some out, or train it on more, "
        "padded with NaN."
    )


def check_not_swapped(
    theta: Any, x: Any, theta_shape: Sequence[int], event_shape: Sequence[int]
) -> None:
    """Raise if theta has the shape of x, and x that of theta.

    Args:
        theta: What the user gave as parameters, of any type.
        x: What the user gave as observations, of any type.
        theta_shape: The shape of one theta.
        event_shape: The shape of one x.

    Raises:
        InvalidInputError: If they look swapped.
    """
    shapes = [tuple(getattr(value, "shape", ()))[1:] for value in (theta, x)]
    expected = [tuple(event_shape), tuple(theta_shape)]
    if shapes == expected and expected[0] != expected[1]:
        raise InvalidInputError(
            f"Expected `theta` of shape {_batch_of(theta_shape)} and `x` of shape "
            f"{_batch_of(event_shape)}; got {tuple(theta.shape)} and "
            f"{tuple(x.shape)}. Did you swap them?"
        )


def _batch_of(event_shape: Sequence[int]) -> str:
    return "(n, " + ", ".join(str(size) for size in event_shape) + ")"
