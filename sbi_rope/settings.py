"""Settings that are checked once, against the type hints that they are written with."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from sbi_rope.errors import InvalidInputError, shown

__all__ = [
    "Count",
    "Level",
    "NotNegative",
    "Number",
    "Positive",
    "Range",
    "Seed",
    "Settings",
    "UnitInterval",
    "Whole",
    "check",
    "default_names",
    "names_of",
    "one_of",
]


@dataclass(frozen=True)
class Range:
    """What a number may be: from ``low`` to ``high``, or only between them if open."""

    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def __contains__(self, value: float) -> bool:
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high and math.isfinite(value)

    def __str__(self) -> str:
        if self.high < math.inf:
            between = "between" if self.open else "from"
            return (
                f"{between} {self.low:g} {'and' if self.open else 'to'} {self.high:g}"
            )
        if self.low == -math.inf:
            return "that is finite"
        return f"{'above' if self.open else 'of at least'} {self.low:g}"


Number = Annotated[float, Range()]
Positive = Annotated[float, Range(0, open=True)]
NotNegative = Annotated[float, Range(0)]
UnitInterval = Annotated[float, Range(0, 1)]
Level = Annotated[float, Range(0, 1, open=True)]
Count = Annotated[int, Range(1)]
Whole = Annotated[int, Range(0)]
Seed = Whole | None


def check(name: str, value: Any, kind: Any) -> None:
    """Raise unless a value is of the kind that a type hint says.

    Args:
        name: What the argument is called.
        value: What the user gave.
        kind: A class, a ``Literal``, a number with a :class:`Range`, or a union.

    Raises:
        InvalidInputError: If it is not.

    Example:
        >>> check("tau", 2, UnitInterval)
        Traceback (most recent call last):
        sbi_rope.errors.InvalidInputError: Expected `tau` to be a number from 0 to 1; \
got 2.
    """
    if not _fits(value, kind):
        raise InvalidInputError(
            f"Expected `{name}` to be {_in_words(kind)}; got {shown(value)}."
        )


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of settings: a frozen dataclass whose fields are what their hints say."""

    def __post_init__(self) -> None:
        """Check every field."""
        kinds = get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            check(field.name, getattr(self, field.name), kinds[field.name])


def one_of(choices: Iterable[Any]) -> Any:
    """Return the kind of values that are one of the choices."""
    return Literal[tuple(choices)]


def names_of(value: Any, count: int) -> tuple[str, ...]:
    """Return ``count`` names of parameters, no two of which are equal.

    Raises:
        InvalidInputError: If they are not.
    """
    names = () if isinstance(value, str) else tuple(value)
    if len(names) != count or len(set(names)) != count:
        raise InvalidInputError(
            f"Expected `parameter_names` to be {count} different names, one for each "
            f"parameter; got {shown(value)}."
        )
    return tuple(str(name) for name in names)


def default_names(count: int) -> tuple[str, ...]:
    """Return the names of parameters that have none of their own.

    Example:
        >>> default_names(2)
        ('theta_1', 'theta_2')
    """
    return tuple(f"theta_{k + 1}" for k in range(count))


def _fits(value: Any, kind: Any) -> bool:
    origin = get_origin(kind)
    if kind is Any:
        return True
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in get_args(kind))
    if origin is Literal:
        return any(
            type(value) is type(choice) and value == choice for choice in get_args(kind)
        )
    if origin is Annotated:
        number, allowed = get_args(kind)
        return _fits(value, number) and float(value) in allowed
    if kind in (int, float):
        number = Integral if kind is int else Real
        return isinstance(value, number) and not isinstance(value, bool)
    return isinstance(value, type(None) if kind is None else origin or kind)


def _in_words(kind: Any) -> str:
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return " or ".join(_in_words(one) for one in get_args(kind))
    if origin is Literal:
        return f"one of {list(get_args(kind))}"
    if origin is Annotated:
        number, allowed = get_args(kind)
        return f"{_in_words(number)} {allowed}"
    if kind in (None, type(None)):
        return "None"
    names = {int: "an integer", float: "a number", bool: "True or False"}
    return names.get(kind, f"a {getattr(origin or kind, '__name__', kind)}")
