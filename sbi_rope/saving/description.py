"""Objects as a description, which is plain text, and the tensors that they hold.

A value that JSON has is itself. All others are lists that begin with a tag:

- ``["list", ...]``, ``["tuple", ...]``, ``["set", ...]`` and ``["size", ...]`` (a
  ``torch.Size``) of values, ``["dict", [key, value], ...]`` and ``["odict", ...]``;
- ``["range", start, stop, step]``, ``["bytes", hexadecimal]``, ``["dtype", name]``,
  ``["device", name]``, ``["complex", real, imaginary]``;
- ``["partial", function, arguments, options]``;
- ``["name", name]``, a class or function, see :mod:`sbi_rope.saving.names`, and
  ``["method", object, name]``, a method of an object;
- ``["tensor", number, content, requires_grad]``, ``["parameter", ...]`` the same, and
  ``["array", content]`` of NumPy. Tensors with the same number are one tensor. Tensors
  of the same content are stored once, and loaded into memory of their own;
- ``["object", number]``, an entry of ``objects``: its class and its attributes.
"""

import copyreg
import functools
import hashlib
import inspect
from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope.errors import InvalidInputError
from sbi_rope.saving.memory import memory_of
from sbi_rope.saving.names import METHODS, name_of

__all__ = ["Description"]

SEQUENCES = {list: "list", tuple: "tuple", set: "set", torch.Size: "size"}
MAPPINGS = {dict: "dict", OrderedDict: "odict"}
# Attributes that hold the device of an object.
DEVICES = ("device", "_device")


class Description:
    """The description of one object and of all that it refers to.

    Args:
        root: The object.
        name: What it is called in errors.

    Attributes:
        objects: For each object the name of its class and its attributes. The first is
            the root, and each is described before those that it refers to.
        tensors: Different contents of tensors, on the CPU.
        named: The classes and functions that are named, by their names.

    Raises:
        InvalidInputError: If a value cannot be described. The error says where it is.
    """

    def __init__(self, root: Any, *, name: str = "posterior") -> None:
        self.objects: list[list[Any]] = []
        self.tensors: list[Tensor] = []
        self.named: dict[str, Any] = {}
        self._numbers: dict[int, int] = {}
        self._tensor_numbers: dict[int, int] = {}
        self._contents: dict[Any, int] = {}
        # Two objects cannot have the same id while both exist.
        self._alive: list[Any] = []
        self._object(root, name)

    @property
    def packages(self) -> set[str]:
        """The packages whose classes are used."""
        return {name.split(".")[0] for name, _ in self.objects}

    def _value(self, value: Any, where: str) -> Any:
        if isinstance(
            value, np.bool_ | np.number
        ):  # such as a setting `np.float64(0.1)`
            value = value.item()
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind in SEQUENCES:
            # Sets have another order in each process.
            values = sorted(value, key=repr) if kind is set else value
            return [SEQUENCES[kind], *self._items(values, where)]
        if kind in MAPPINGS:
            pairs = (
                [self._value(key, where), self._entry(key, entry, where)]
                for key, entry in value.items()
            )
            return [MAPPINGS[kind], *pairs]
        if isinstance(value, Tensor):
            return self._tensor(value, where)
        if kind is np.ndarray and value.dtype.kind in "biufc":
            return ["array", self._content(torch.from_numpy(np.array(value)))]
        if kind is functools.partial:
            arguments = (value.func, value.args, value.keywords)
            return ["partial", *self._items(arguments, where)]
        if inspect.ismethod(value) and value.__name__ in METHODS:
            owner = self._object(value.__self__, where)
            return ["method", owner, value.__name__]
        if isinstance(value, type) or inspect.isroutine(value):
            return ["name", self._name(value, where)]
        return _simple(value) or ["object", self._object(value, where)]

    def _entry(self, key: Any, value: Any, where: str) -> Any:
        # Tensors are stored on the CPU, and sbi keeps the names of their devices.
        if key in DEVICES and isinstance(value, str | torch.device):
            value = type(value)("cpu")
        return self._value(value, _inside(where, key))

    def _items(self, values: Any, where: str) -> list[Any]:
        return [
            self._value(entry, f"{where}[{number}]")
            for number, entry in enumerate(values)
        ]

    def _object(self, value: Any, where: str) -> int:
        """Describe an object unless it is known, and return its number."""
        if id(value) in self._numbers:
            return self._numbers[id(value)]
        number = self._numbers[id(value)] = len(self.objects)
        self._alive.append(value)
        self.objects.append([self._kept_name(type(value)), None])
        self.objects[number][1] = self._value(_attributes(value, where), where)
        return number

    def _name(self, value: Any, where: str) -> str:
        name = getattr(value, "__qualname__", "")
        if inspect.ismethod(value):
            raise _not_described(f"the method {name}", where)
        if "<lambda>" in name or "<locals>" in name:
            raise _not_described(f"the function {name}", where)
        return self._kept_name(value)

    def _kept_name(self, value: Any) -> str:
        name = name_of(value)
        self.named[name] = value
        return name

    def _tensor(self, value: Tensor, where: str) -> list[Any]:
        if type(value) not in (Tensor, nn.Parameter) or value.layout != torch.strided:
            raise _not_described(f"a {type(value).__name__} ({value.layout})", where)
        known = self._tensor_numbers
        number = known.setdefault(id(value), len(known))
        self._alive.append(value)
        tag = "parameter" if isinstance(value, nn.Parameter) else "tensor"
        return [tag, number, self._content(value), value.requires_grad]

    def _content(self, value: Tensor) -> int:
        """Return the number of a tensor's content, which is stored once."""
        # A copy of its own: a view would take all memory that it is a view of into the
        # file. A copy keeps the order in memory, on which rounding depends.
        content = value.detach().cpu().clone()
        digest = hashlib.blake2b(memory_of(content).tobytes()).digest()
        key = (content.dtype, content.shape, content.stride(), digest)
        if key not in self._contents:
            self._contents[key] = len(self.tensors)
            self.tensors.append(content)
        return self._contents[key]


def _simple(value: Any) -> list[Any] | None:
    """Describe a value that consists of numbers and text only; None for others."""
    if isinstance(value, range):
        return ["range", value.start, value.stop, value.step]
    if type(value) is bytes:
        return ["bytes", value.hex()]
    if type(value) is complex:
        return ["complex", value.real, value.imag]
    if isinstance(value, torch.dtype):
        return ["dtype", str(value).removeprefix("torch.")]
    if isinstance(value, torch.device):
        return ["device", str(value)]
    return None


def _attributes(value: Any, where: str) -> Any:
    """Return the attributes of an object, as they would be pickled."""
    try:
        make, arguments, state, *items = [*value.__reduce_ex__(2), None, None][:5]
    except Exception as error:  # of whatever the class does when it is pickled
        raise _not_described(f"{_named(value)}, which says: {error}", where) from error
    is_plain = make is copyreg.__newobj__ and arguments == (type(value),)  # type: ignore[attr-defined]
    if not is_plain or any(item is not None for item in items):
        raise _not_described(_named(value), where)
    return state


def _named(value: Any) -> str:
    return f"an object of the class {type(value).__module__}.{type(value).__qualname__}"


def _inside(where: str, key: Any) -> str:
    """Return where a value is, as a user would write it."""
    where = where.removesuffix("._modules").removesuffix("._parameters")
    return f"{where}.{key}" if isinstance(key, str) else f"{where}[{key!r}]"


def _not_described(what: str, where: str) -> InvalidInputError:
    return InvalidInputError(
        f"Expected objects that can be described in a file; got {what} at "
        f"`{where}`. Use a class, or a function written with `def`, that a module "
        "defines, and name it in `sbi_rope.load(path, trusted=[...])`. Objects that "
        "define how they are pickled cannot be described: leave them out, or pickle "
        "the posterior instead, for yourself only."
    )
