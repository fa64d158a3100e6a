"""Posteriors in files that are loaded without running code from the file.

Torch reads the file with ``weights_only=True``, which allows only what is listed:
classes that derive from one of our bases and are defined in one of a few packages, and
a few functions of tensors. None of these imports by name, evaluates text, opens a file
or unpickles. In the place of a class, torch finds what makes empty objects only, except
for distributions and transforms, which zuko calls.
"""

import functools
import importlib
import pickle
import zipfile
from collections.abc import Sequence
from dataclasses import is_dataclass
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import sbi
import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Transform
from torch.distributions.constraints import Constraint
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from sbi_rope.npe.sbi import BasePotential, NeuralPosterior
from sbi_rope.utils.errors import DataNotFoundError, FileFormatError
from sbi_rope.utils.files import write_atomically
from sbi_rope.utils.settings import check

LAWS = (Distribution, Transform)
BASES = (nn.Module, *LAWS, Constraint, NeuralPosterior, BasePotential)
# Other posteriors of sbi run more code when they are loaded.
ROOMS = (
    *("torch.nn.modules.", "torch.distributions.", "zuko."),
    *("nflows.distributions.", "nflows.flows.", "nflows.nn.", "nflows.transforms."),
    "sbi.inference.posteriors.direct_posterior.",
    "sbi.inference.posteriors.npe_a_posterior.",
    "sbi.inference.posteriors.vector_field_posterior.",
    *("sbi.inference.potentials.", "sbi.neural_nets.", "sbi.samplers.ode_solvers."),
    *("sbi.utils.", "sbi_rope."),
)
# Dataclasses of these rooms are results. Others call what they hold, or run programs.
RESULTS = (
    *("sbi_rope.metrics.statistics.", "sbi_rope.baselines.", "sbi_rope.coupling."),
    *("sbi_rope.data.pairs.Counts", "sbi_rope.density.sets.SetScores"),
    *("sbi_rope.discrepancy.", "sbi_rope.metrics.", "sbi_rope.stacking."),
    "sbi_rope.tasks.hemodynamics.prior_table.",
)
# Functions of zuko that make transforms, and a class of nflows that holds tensors.
OTHERS = (
    "zuko.flows.polynomial.ShiftedSOSPTransform",
    "zuko.flows.spline.CircularRQSTransform",
    "nflows.transforms.linear.LinearCache",
)
ACTIVATIONS = (
    *("celu", "elu", "hardswish", "hardtanh", "leaky_relu", "mish", "relu", "relu6"),
    *("selu", "silu", "softmax", "softsign", "tanhshrink"),
)
# Pickle finds these as attributes: functions of torch, and methods of vector fields.
# Some other methods write files.
OF_TORCH = ("exp", "relu", "selu", "sigmoid", "sin", "tanh")
METHODS = (
    *("ode_fn", "_f_condition_last", "_identity_weight_fn"),
    *("_max_likelihood_weight_fn", "_variance_weight_fn"),
)


def save(posterior: Any, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a posterior to a file that :func:`load` reads.

    The file is written completely or not at all.

    Args:
        posterior: A posterior of this package, or a ``DirectPosterior`` or
            ``VectorFieldPosterior`` of sbi, which several trainers return.
        path: The file. Its folder is made if there is none.
        overwrite: Whether to replace a file that exists.

    Example:
        >>> import tempfile, torch
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.density import PriorPosterior
        >>> posterior = PriorPosterior(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(posterior, f"{folder}/posterior.pt")
        ...     again = load(f"{folder}/posterior.pt")
        >>> again.sample((5,)).shape
        torch.Size([5, 2])
    """
    check("posterior", posterior, NeuralPosterior)
    path = Path(path).expanduser()
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists. Pass overwrite=True to replace it.")
    content = {"versions": _versions(), "posterior": posterior}
    pickler = SimpleNamespace(__name__="pickle", Pickler=_Pickler)
    with write_atomically(path) as temporary:
        torch.save(content, temporary, pickle_module=pickler)


def load(path: str | Path, *, trusted: Sequence[Any] = ()) -> Any:
    """Read a posterior that was saved, without running code from the file.

    A file may hold networks, distributions and transforms of torch, nflows, zuko and
    sbi, and classes of this package. All others have to be named. The posterior is on
    the CPU, wherever it was when it was saved; ``posterior.to("cuda")`` moves it.

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
    for one in trusted:
        check("trusted", one, type | FunctionType)
    # What was defined in a notebook or script may have moved to a module since.
    known = {f"__main__.{one.__qualname__}": one for one in trusted}
    known |= {f"{one.__module__}.{one.__qualname__}": one for one in trusted}
    try:
        content = _content(path, known)
        posterior, versions = content["posterior"], content["versions"]
        if not isinstance(posterior, NeuralPosterior):
            raise TypeError("it holds no posterior")
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
        posterior.to("cpu")  # type: ignore[attr-defined]
    return posterior


def _content(path: Path, known: dict[str, Any]) -> Any:
    with zipfile.ZipFile(path) as archive:
        if archive.testzip() is not None:  # torch does not compare check sums
            raise ValueError("a check sum is wrong")
    names = get_unsafe_globals_in_checkpoint(path)
    needed = {name: known.get(name) or _found(name) for name in names}
    if unknown := sorted(name for name in names if needed[name] is None):
        classes = ", ".join(name.rpartition(".")[2] for name in unknown)
        raise FileFormatError(
            f"{path} needs {', '.join(unknown)}, which could run anything. If you "
            f"trust its author, import it and pass `trusted=[{classes}]`."
        )
    allowed: list[Any] = []
    for name, value in needed.items():
        is_called = name in known or _may_be_called(value)
        allowed.append((value if is_called else _Maker(value), name))
        # Torch fills objects only if their class is listed. No file can name this.
        allowed.append((value, f"{name}\n"))
    with safe_globals(allowed):
        return torch.load(path, map_location="cpu", weights_only=True)


class _Pickler(pickle.Pickler):
    """Writes arrays as tensors, because the pickles of NumPy name functions."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, np.ndarray | np.number | np.bool_):
            return _from_tensor, (torch.as_tensor(obj),)
        return NotImplemented


def _from_tensor(value: Tensor) -> Any:
    return value.numpy()[()]


def _attribute(owner: Any, name: str) -> Any:
    """Stand for ``getattr``, which would find any attribute."""
    if owner == "torch" and name in OF_TORCH:
        return getattr(torch, name)
    if isinstance(owner, nn.Module) and name in METHODS:
        return getattr(owner, name)
    raise FileFormatError(f"A file must not ask for the attribute {name!r}.")


LISTED = {
    **{f"torch.nn.functional.{k}": getattr(nn.functional, k) for k in ACTIVATIONS},
    "torch._C._nn.gelu": nn.functional.gelu,
    "torch._C._nn.log_sigmoid": nn.functional.logsigmoid,
    "torch._C._nn.softplus": nn.functional.softplus,
    "torch._C._VariableFunctionsClass": "torch",
    "functools.partial": functools.partial,
    "builtins.range": range,
    "builtins.getattr": _attribute,
    f"{__name__}._from_tensor": _from_tensor,
}


def _found(name: str) -> Any:
    """Return what a file may name without being trusted; None if it is not known."""
    if name in LISTED or not name.startswith(ROOMS):
        return LISTED.get(name)
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
    if getattr(found, "__module__", None) != module:
        return None  # a module may use what is harmful, but not define it
    if name in OTHERS:
        return found
    is_result = name.startswith(RESULTS) and is_dataclass(found)
    is_known = isinstance(found, type) and (is_result or issubclass(found, BASES))
    return found if is_known else None


def _may_be_called(value: Any) -> bool:
    if not isinstance(value, type) or value in LISTED.values():
        return True
    return issubclass(value, LAWS) and value.__module__.startswith(("torch.", "zuko."))


class _Maker:
    """Makes empty objects of a class, and cannot be called as its constructor can."""

    def __init__(self, kind: type) -> None:
        # Torch calls what it takes for the `__new__` of a class.
        vars(self)["__new__"] = lambda _: object.__new__(kind)


def _versions() -> dict[str, str]:
    versions = {"sbi": sbi.__version__, "sbi_rope": version("sbi-rope")}
    return {name: ".".join(v.split(".")[:2]) for name, v in versions.items()}
