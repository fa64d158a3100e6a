"""How results look as the last line of a notebook's cell."""

from typing import Any, TypeVar

__all__ = ["shown_as_text"]

Result = TypeVar("Result")


def shown_as_text(of: type[Result]) -> type[Result]:
    """Let notebooks show results of a class as ``print`` does, not field by field.

    A class above it would not do: IPython prefers the ``__repr__`` of a dataclass to
    what this inherits.
    """
    of._repr_pretty_ = _write_text  # type: ignore[attr-defined]
    return of


def _write_text(result: Any, printer: Any, cycle: bool) -> None:  # noqa: FBT001
    """Write the text of a result; IPython calls it."""
    printer.text("..." if cycle else str(result))
