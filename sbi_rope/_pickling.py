"""Functions of a user that can be pickled, also those without a name of their own."""

import pickle
import types
from collections.abc import Callable
from typing import Any

import joblib

from sbi_rope.errors import InvalidInputError

__all__ = ["packed", "picklable"]


def picklable(function: Any) -> Any:
    """Return a function in a form that can be pickled; anything else as it is.

    Python pickles a function by the name that it has in its module, so that a lambda,
    and a function that was defined inside another one, cannot be pickled. joblib
    pickles such a function by its code.
    """
    return _Function(function) if isinstance(function, types.FunctionType) else function


def packed(thing: Any) -> bytes:
    """Return the pickle of anything, functions without a name of their own included."""
    return pickle.dumps(joblib.wrap_non_picklable_objects(thing, keep_wrapper=False))


class _Function:
    """Calls a function. A copy calls the same function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.function(*args, **kwargs)

    def __deepcopy__(self, memo: dict[int, Any]) -> "_Function":
        return self  # as functions do, so that a copy needs no pickle

    def __reduce__(self) -> tuple[Any, ...]:
        by_code: Any = joblib.wrap_non_picklable_objects(
            self.function, keep_wrapper=False
        )
        try:
            load, arguments = by_code.__reduce__()
        except Exception as error:  # of whatever the function refers to
            name = self.function.__qualname__
            raise InvalidInputError(
                f"Expected a simulator that can be pickled; {name} refers to something "
                f"that cannot ({type(error).__name__}: {error}). Define it with `def` "
                "in a module, and open files and connections inside of it."
            ) from error
        return _loaded, (load, arguments)


def _loaded(load: Callable[..., Any], arguments: tuple[Any, ...]) -> _Function:
    return _Function(load(*arguments))
