"""Posteriors in files that are loaded without running code from the file.

Torch reads the file with ``weights_only=True`` and makes only what is on a list:
networks, distributions and posteriors of a few packages, dataclasses of this one, and
functions of tensors. None imports by name, evaluates text, opens a file or unpickles.
"""

import functools
import importlib
import pickle
from collections.abc import Sequence
from dataclasses import is_dataclass
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import sbi
import torch
from sbi.inference import DirectPosterior, VectorFieldPosterior
from torch import Tensor, nn
from torch.distributions import Distribution, Transform
from torch.distributions.constraints import Constraint
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from sbi_rope.npe.sbi import BasePotential
from sbi_rope.utils.errors import DataNotFoundError, FileFormatError
from sbi_rope.utils.files import write_atomically
from sbi_rope.utils.settings import check

# Other posteriors of sbi run more code when they are loaded.
Posterior = DirectPosterior | VectorFieldPosterior
BASES = (nn.Module, Distribution, Transform, Constraint, Posterior, BasePotential)
PACKAGES = ("sbi.", "sbi_rope.", "torch.distributions.", "torch.nn.modules.")
# All that these define works on tensors only.
OF_TENSORS = ("nflows.", "torch._C._nn.", "torch.nn.functional.", "zuko.")
# Functions that pickle finds as attributes of torch.
OF_TORCH = ("exp", "relu", "selu", "sigmoid", "sin", "tanh")


def save(posterior: Any, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a posterior to a file that :func:`load` reads, completely or not at all.

    Args:
        posterior: A posterior of this package, or a ``DirectPosterior`` or
            ``VectorFieldPosterior`` of sbi, which several trainers return.
        path: The file. Its folder is made if there is none.
        overwrite: Whether to replace a file that exists.
    """
    check("posterior", posterior, Posterior)
    path = Path(path).expanduser()
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists. Pass overwrite=True to replace it.")
    pickler = SimpleNamespace(__name__="pickle", Pickler=_Pickler)
    content = {"versions": _versions(), "posterior": posterior}
    with write_atomically(path) as temporary:
        torch.save(content, temporary, pickle_module=pickler)


def load(path: str | Path, *, trusted: Sequence[Any] = ()) -> Any:
    """Read a posterior that was saved, without running code from the file.

    A file may hold networks, distributions and transforms of torch, nflows, zuko and
    sbi, and classes of this package. All others have to be named. The posterior is on
    the CPU.

    Args:
        path: The file.
        trusted: Your own classes and functions that the posterior needs, such as the
            class of an embedding net or prior. Their code may run.

    Raises:
        FileFormatError: If it is not a file of :func:`save`, is damaged, was written by
            other versions of the packages, or needs a class that is not trusted.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise DataNotFoundError(f"Expected a file at {path}; got none.")
    own = {f"{one.__module__}.{one.__qualname__}": one for one in trusted}
    try:
        names = get_unsafe_globals_in_checkpoint(path)
        found = {name: own.get(name) or _found(name) for name in names}
        if unknown := sorted(name for name in names if found[name] is None):
            classes = ", ".join(name.rpartition(".")[2] for name in unknown)
            raise FileFormatError(
                f"{path} needs {', '.join(unknown)}, which could run anything. If you "
                f"trust its author, import it and pass `trusted=[{classes}]`."
            )
        with safe_globals([(value, name) for name, value in found.items()]):
            content = torch.load(path, map_location="cpu", weights_only=True)
        posterior, versions = content["posterior"], content["versions"]
        check("posterior", posterior, Posterior)
    except FileFormatError:
        raise
    except Exception as error:  # a damaged file may lead to any
        raise FileFormatError(
            f"Expected a whole file of `save`; {path} is none or is damaged "
            f"({type(error).__name__}). No code in it was run."
        ) from error
    if versions != _versions():
        raise FileFormatError(
            f"Expected a file of {_versions()}; {path} is of {versions}. Install these "
            "versions, or build the posterior and save it again."
        )
    if torch.device(posterior.potential_fn.device).type != "cpu":
        posterior.to("cpu")
    return posterior


class _Pickler(pickle.Pickler):
    """Writes arrays as tensors, because the pickles of NumPy name functions."""

    def reducer_override(self, obj: Any) -> Any:
        is_array = isinstance(obj, np.ndarray | np.number | np.bool_)
        return (_from_tensor, (torch.as_tensor(obj),)) if is_array else NotImplemented


def _from_tensor(value: Tensor) -> Any:
    return value.numpy()[()]


def _attribute(owner: Any, name: str) -> Any:
    """Stand for ``getattr``, which would find any attribute."""
    if owner == "torch" and name in OF_TORCH:
        return getattr(torch, name)
    if type(owner).__module__.startswith("sbi.") and isinstance(owner, nn.Module):
        return getattr(owner, name)  # vector fields hold methods of their own
    raise FileFormatError(f"A file must not ask for the attribute {name!r}.")


LISTED = {
    "torch._C._VariableFunctionsClass": "torch",
    "functools.partial": functools.partial,
    "builtins.range": range,
    "builtins.getattr": _attribute,
    f"{__name__}._from_tensor": _from_tensor,
}


def _found(name: str) -> Any:
    """Return what a file may name without being trusted; None if it is not known."""
    if name in LISTED or not name.startswith((*PACKAGES, *OF_TENSORS)):
        return LISTED.get(name)
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
    if getattr(found, "__module__", None) != module:
        return None  # a module may use what is harmful, but not define it
    is_result = name.startswith("sbi_rope.") and is_dataclass(found)
    is_known = isinstance(found, type) and (is_result or issubclass(found, BASES))
    return found if is_known or name.startswith(OF_TENSORS) else None


def _versions() -> dict[str, str]:
    versions = {"sbi": sbi.__version__, "sbi_rope": version("sbi-rope")}
    return {name: ".".join(v.split(".")[:2]) for name, v in versions.items()}
