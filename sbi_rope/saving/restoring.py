"""Objects from their description, see :mod:`sbi_rope.saving.description`."""

import functools
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.errors import UntrustedError
from sbi_rope.saving.memory import dtype_named
from sbi_rope.saving.names import METHODS, find_class, find_value

__all__ = ["restored"]


SEQUENCES = {"list": list, "tuple": tuple, "set": set, "size": torch.Size}
MAPPINGS = {"dict": dict, "odict": OrderedDict}
SIMPLE: dict[str, Callable[..., Any]] = {
    "range": range,
    "bytes": bytes.fromhex,
    "complex": complex,
    "dtype": dtype_named,
    "device": torch.device,
}


def restored(
    objects: Sequence[Any], tensors: Sequence[Tensor], trusted: Mapping[str, Any]
) -> Any:
    """Return the first of the objects, with all that it refers to.

    No constructor is called. Objects are made empty, and then filled, those that a
    description refers to first.

    Args:
        objects: As in :class:`~sbi_rope.saving.description.Description`.
        tensors: As in :class:`~sbi_rope.saving.description.Description`.
        trusted: Classes and functions of the user, by name.

    Raises:
        UntrustedError: If a class or function is not known.
    """
    reader = _Reader(tensors, trusted)
    classes = {name: find_class(name, trusted) for name, _ in objects}
    unknown = [name for name, found in classes.items() if found is None]
    if unknown:
        raise _untrusted(unknown)
    reader.objects = [object.__new__(classes[name]) for name, _ in objects]  # type: ignore[type-var]
    pairs = list(zip(reader.objects, objects, strict=True))
    for instance, (_, description) in reversed(pairs):
        _fill(instance, reader.value(description))
    return reader.objects[0]


def _fill(instance: Any, state: Any) -> None:
    if hasattr(instance, "__setstate__"):
        instance.__setstate__(state)
    elif state is not None:
        vars(instance).update(state)


class _Reader:
    """Turns descriptions into values.

    Attributes:
        objects: The objects that descriptions refer to.
    """

    def __init__(self, tensors: Sequence[Tensor], trusted: Mapping[str, Any]) -> None:
        self.objects: list[Any] = []
        self._tensors = tensors
        self._trusted = trusted
        self._made: dict[int, Tensor] = {}
        self._used: set[int] = set()

    def value(self, description: Any) -> Any:
        """Return the value that is described."""
        match description:
            case ["object", number]:
                return self.objects[number]
            case ["tensor" | "parameter" as tag, number, content, requires_grad]:
                if number not in self._made:
                    made = self._own(content)
                    made = nn.Parameter(made) if tag == "parameter" else made
                    self._made[number] = made.requires_grad_(requires_grad)
                return self._made[number]
            case ["array", content]:
                return self._own(content).numpy()
            case ["name", name]:
                return self._named(name)
            case ["method", number, name] if name in METHODS:
                return getattr(self.objects[number], name)
            case ["partial", function, arguments, options]:
                parts = map(self.value, (function, arguments, options))
                function, arguments, options = parts
                return functools.partial(function, *arguments, **options)
            case ["list" | "tuple" | "set" | "size" as tag, *items]:
                return SEQUENCES[tag](map(self.value, items))
            case ["dict" | "odict" as tag, *pairs]:
                return MAPPINGS[tag](map(self.value, pair) for pair in pairs)
            case [tag, *content]:
                return SIMPLE[tag](*content)
        return description

    def _named(self, name: str) -> Callable[..., Any]:
        found = find_value(name, self._trusted)
        if found is None:
            raise _untrusted([name])
        return found

    def _own(self, content: int) -> Tensor:
        """Return the content of a tensor, in memory that no other tensor has."""
        found = self._tensors[content]
        if content in self._used:
            return found.clone()
        self._used.add(content)
        return found


def _untrusted(names: Sequence[str]) -> UntrustedError:
    classes = ", ".join(name.rpartition(".")[2] for name in names)
    return UntrustedError(
        f"The file needs {', '.join(names)}, which this package does not know. A class "
        "or function of somebody else's file could do anything on this computer. If "
        "you wrote it, or trust whoever did, import it and pass it: "
        f"`sbi_rope.load(path, trusted=[{classes}])`."
    )
