"""Settings that are checked once, against the type hints that they are written with."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from sbi_rope.utils.errors import InvalidInputError, shown


@dataclass(frozen=True)
class Range:
    """The finite numbers from ``low`` to ``high``, without these two if open."""

    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def __contains__(self, value: float) -> bool:
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high and -math.inf < value < math.inf

    def __str__(self) -> str:
        if self.high < math.inf:
            words = ("between", "and") if self.open else ("from", "to")
            return f"{words[0]} {self.low:g} {words[1]} {self.high:g}"
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
    """Raise :class:`InvalidInputError` unless a value fits a type hint.

    A hint is a class, a ``Literal``, a number with a :class:`Range`, a ``Sequence`` of
    such, or a union.
    """
    if not _fits(value, kind):
        raise InvalidInputError(
            f"Expected `{name}` to be {_in_words(kind)}; got {shown(value)}."
        )


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of settings: a frozen dataclass whose fields fit their type hints."""

    def __post_init__(self) -> None:
        kinds = get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            check(field.name, getattr(self, field.name), kinds[field.name])


def one_of(choices: Iterable[Any]) -> Any:
    """Return the type hint of a value that is one of the choices."""
    return Literal[tuple(choices)]


def names_of(value: Any, count: int) -> tuple[str, ...]:
    """Return ``count`` names of parameters; raise unless they are all different."""
    is_list = isinstance(value, Iterable) and not isinstance(value, str)
    names = tuple(map(str, value)) if is_list else ()
    if len(names) != count or len(set(names)) != count:
        raise InvalidInputError(
            f"Expected `parameter_names` to be {count} different names, one for each "
            f"parameter; got {shown(value)}."
        )
    return names


def default_names(count: int) -> tuple[str, ...]:
    """Return the names theta_1, theta_2, ... of parameters that have none."""
    return tuple(f"theta_{k + 1}" for k in range(count))


def _fits(value: Any, kind: Any) -> bool:
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return True
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:  # True is not the number 1, but NumPy's 64 is 64
        return any(_fits(value, type(part)) and value == part for part in parts)
    if origin is Annotated:
        return _fits(value, parts[0]) and value in parts[1]
    if origin in (Sequence, tuple):
        is_list = isinstance(value, origin) and not isinstance(value, str)
        return is_list and len(value) > 0 and all(_fits(v, parts[0]) for v in value)
    if kind in (int, float):
        number = Integral if kind is int else Real
        return isinstance(value, number) and not isinstance(value, bool)
    return isinstance(value, origin or kind or NoneType)


def _in_words(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(map(_in_words, parts))
    if origin is Literal:
        return f"one of {list(parts)}"
    if origin is Annotated:
        return f"{_in_words(parts[0])} {parts[1]}"
    if origin in (Sequence, tuple):
        return f"a list with each entry {_in_words(parts[0])}"
    if kind in (None, NoneType):
        return "None"
    names = {int: "an integer", float: "a number", bool: "True or False"}
    return names.get(kind, f"a {getattr(origin or kind, '__name__', kind)}")
