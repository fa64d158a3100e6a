"""The classes and functions that a file may name without being trusted.

A file describes objects by the name of their class and by their attributes, and the
loader does two things only with what the file says. It makes an empty object of a class
with ``object.__new__``, which runs no code of that class. Then it fills the object's
attributes, through the ``__setstate__`` of the class if it has one. No constructor is
called, and no function. So a file can do harm in two ways only: by a class whose
``__setstate__`` or whose methods run what they find in their attributes, and by a
function or class that an attribute holds and a method calls later.

Both are closed by what may be named:

- Classes of the modules in :data:`ROOMS`, and only those that derive from the base
  classes that are given there. These are networks, distributions, transforms,
  posteriors, and results of this package. None of these modules evaluates text, imports
  by name, opens a file, or unpickles. Only torch's own networks and sbi's posteriors
  have a ``__setstate__``, and these set attributes only. A whole package is never
  allowed by its name: ``torch`` contains ``torch.fx.GraphModule``, for example, a
  network whose attributes hold its source code.
- Of functions and methods, those in :data:`FUNCTIONS`, :data:`METHODS` and
  :data:`MAKERS` only, which compute with tensors. Other methods are not allowed,
  because posteriors of this package have one that writes a file. A class as the value
  of an attribute is called by a method of zuko to make a distribution or a transform.
  It has to be such a class, of torch or zuko.

A module is imported only if it is one of these rooms, all of which come with this
package and its dependencies. SciPy's distributions are not among them: their
``__setstate__`` evaluates text. They, and the user's own classes, have to be named by
the person who loads the file.
"""

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.distributions import Distribution, Transform
from torch.distributions.constraints import Constraint

from sbi_rope._sbi import (
    BasePotential,
    DirectPosterior,
    NeuralPosterior,
    VectorFieldPosterior,
)
from sbi_rope.errors import InvalidInputError

__all__ = [
    "FUNCTIONS",
    "METHODS",
    "find_class",
    "find_value",
    "name_of",
    "trusted_names",
]

_KINDS = (nn.Module, Distribution, Transform, Constraint)
_POSTERIORS = (NeuralPosterior, BasePotential)
# Others of sbi, such as that of variational inference, run more code when loaded.
_POSTERIORS_OF_SBI = (DirectPosterior, VectorFieldPosterior, BasePotential)
# The modules whose classes may be named, and what such a class has to derive from.
ROOMS: dict[str, tuple[type, ...]] = {
    "torch.nn.modules": (nn.Module,),
    "torch.distributions": (Distribution, Transform, Constraint),
    "nflows.distributions": (nn.Module,),
    "nflows.flows": (nn.Module,),
    "nflows.nn": (nn.Module,),
    "nflows.transforms": (nn.Module,),
    "zuko": _KINDS,
    "sbi.inference.posteriors": _POSTERIORS_OF_SBI,
    "sbi.inference.potentials": _POSTERIORS_OF_SBI,
    "sbi.neural_nets": (nn.Module,),
    "sbi.samplers.ode_solvers": (nn.Module,),
    "sbi.utils": _KINDS,
    "sbi_rope._sbi": (*_KINDS, *_POSTERIORS),
    "sbi_rope._standardisation": (nn.Module,),
    "sbi_rope._two_sample": (),
    "sbi_rope.baselines": (*_KINDS, *_POSTERIORS),
    "sbi_rope.coupling": (),
    "sbi_rope.discrepancy": (*_KINDS, *_POSTERIORS),
    "sbi_rope.metrics": (),
    "sbi_rope.mixture": (*_KINDS, *_POSTERIORS),
    "sbi_rope.stacking": _POSTERIORS,
    "sbi_rope.tasks.hemodynamics.prior_table": (),
    "sbi_rope.tasks": _KINDS,
}
# Dataclasses of these rooms are results, which hold numbers, tensors and networks.
RESULTS = tuple(
    f"sbi_rope.{room}"
    for room in (
        *("_two_sample", "baselines", "coupling", "discrepancy", "metrics"),
        *("stacking", "tasks.hemodynamics.prior_table"),
    )
)
# It derives from none of these, and holds tensors.
OTHER_CLASSES = {"nflows.transforms.linear.LinearCache"}
# Of these an attribute may hold the class itself.
AS_VALUES = ("torch.distributions", "zuko")

# Functions of tensors that networks have as attributes, most of them activations.
FUNCTIONS = {
    **{
        f"torch.{name}": getattr(torch, name)
        for name in ("exp", "relu", "selu", "sigmoid", "sin", "tanh")
    },
    **{
        f"torch.nn.functional.{name}": getattr(nn.functional, name)
        for name in (
            *("celu", "elu", "gelu", "hardswish", "hardtanh", "leaky_relu"),
            *("logsigmoid", "mish", "relu", "relu6", "selu", "silu", "softmax"),
            *("softplus", "softsign", "tanhshrink"),
        )
    },
}
# Methods that sbi's vector fields keep as attributes.
METHODS = {
    *("ode_fn", "_f_condition_last"),
    *("_identity_weight_fn", "_max_likelihood_weight_fn"),
    "_variance_weight_fn",
}
# Functions of zuko that make transforms. They are found when they are needed.
MAKERS = {
    "zuko.flows.polynomial.ShiftedSOSPTransform",
    "zuko.flows.spline.CircularRQSTransform",
}


def name_of(value: Any) -> str:
    """Return the name by which a file refers to a class or function."""
    for name, function in FUNCTIONS.items():
        if value is function:
            return name
    return f"{value.__module__}.{value.__qualname__}"


def trusted_names(trusted: Any) -> dict[str, Any]:
    """Return the classes and functions that a user trusts, by name.

    Raises:
        InvalidInputError: If there is something else among them.
    """
    if not isinstance(trusted, Sequence) or isinstance(trusted, str):
        raise InvalidInputError(
            "Expected `trusted` to be a list of classes and functions, such as "
            f"[MyNet]; got {type(trusted).__name__}."
        )
    for value in trusted:
        if not isinstance(value, type) and not inspect.isroutine(value):
            raise InvalidInputError(
                "Expected `trusted` to hold classes and functions themselves, such as "
                f"[MyNet]; got {value!r} among them."
            )
    names = {name_of(value): value for value in trusted}
    # What was defined in a notebook or script may have moved to a module since.
    moved = {f"__main__.{value.__qualname__}": value for value in trusted}
    return {**moved, **names}


def find_class(name: str, trusted: Mapping[str, Any]) -> type | None:
    """Return the class that an object of a file has; None if it is not known."""
    if name in trusted:
        return trusted[name] if isinstance(trusted[name], type) else None
    room = _room_of(name)
    found = None if room is None else _imported(name)
    if room is None or not isinstance(found, type):
        return None
    is_result = room in RESULTS and dataclasses.is_dataclass(found)
    if is_result or name in OTHER_CLASSES or issubclass(found, ROOMS[room]):
        return found
    return None


def find_value(name: str, trusted: Mapping[str, Any]) -> Callable[..., Any] | None:
    """Return the class or function that an attribute holds; None if not known."""
    if name in trusted:
        return trusted[name]
    if name in FUNCTIONS:
        return FUNCTIONS[name]
    if name in MAKERS:
        return _imported(name)
    if _room_of(name) not in AS_VALUES:
        return None
    found = _imported(name)
    is_law = isinstance(found, type) and issubclass(found, Distribution | Transform)
    return found if is_law else None


def _room_of(name: str) -> str | None:
    rooms = (room for room in ROOMS if name.startswith(f"{room}."))
    return next(rooms, None)


def _imported(name: str) -> Any:
    """Return what a module of the rooms defines under a name, and not what it uses."""
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
    return found if getattr(found, "__module__", None) == module else None
