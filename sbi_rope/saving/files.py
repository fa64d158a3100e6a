"""Write a posterior to a file, and read it again."""

import importlib
import importlib.metadata
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sbi_rope._files import read_arrays, write_atomically
from sbi_rope._sbi import NeuralPosterior
from sbi_rope._validation import check_path
from sbi_rope.errors import (
    DataNotFoundError,
    FileFormatError,
    InvalidInputError,
    NotWritableError,
    RoPEError,
    shown,
)
from sbi_rope.saving.description import Description
from sbi_rope.saving.memory import packed, unpacked
from sbi_rope.saving.names import trusted_names
from sbi_rope.saving.restoring import restored
from sbi_rope.settings import check

__all__ = ["load", "read_object", "save", "versions_of", "write_object"]

FORMAT = "sbi_rope posterior"
# It changes when older versions of the package could not read newer files.
FORMAT_VERSION = 1
# A file depends on the attributes of these packages' classes, if it has some of them.
PACKAGES = ("sbi_rope", "sbi", "torch", "nflows", "zuko")


def save(posterior: Any, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a posterior to a file that :func:`load` reads.

    The file holds networks, prior, observations and results as numbers and text, and no
    code. Tensors of the same content are stored once. The file is written completely or
    not at all.

    Args:
        posterior: A posterior of this package, or a ``DirectPosterior`` or
            ``VectorFieldPosterior`` of sbi, which several trainers return.
        path: The file. Its folder is made if there is none.
        overwrite: Whether to replace a file that exists.

    Raises:
        InvalidInputError: If an argument has the wrong type.
        InvalidInputError: If the posterior holds something that cannot be described,
            such as a lambda.
        NotWritableError: If the file exists, or cannot be written.

    Example:
        >>> import tempfile, torch
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.mixture import PriorPosterior
        >>> posterior = PriorPosterior(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(posterior, f"{folder}/posterior.pt")
        ...     again = load(f"{folder}/posterior.pt")
        >>> again.sample((5,)).shape
        torch.Size([5, 2])
    """
    if not isinstance(posterior, NeuralPosterior):
        hint = ""
        if hasattr(posterior, "build_posterior"):
            hint = " Save what its `build_posterior` returns."
        raise InvalidInputError(
            "Expected `posterior` to be a posterior of sbi or sbi_rope; got "
            f"{type(posterior).__name__}.{hint}"
        )
    target = _path(path)
    check("overwrite", overwrite, bool)
    if target.is_dir():
        raise NotWritableError(
            f"Expected `path` to be a file; got the folder {target}. Add a name, such "
            "as 'posterior.pt'."
        )
    if target.exists() and not overwrite:
        raise NotWritableError(
            f"Expected a `path` where there is no file yet; got {target}. Use another "
            "name, or pass overwrite=True."
        )
    write_object(posterior, target)


def load(path: str | Path, *, trusted: Sequence[type | Callable[..., Any]] = ()) -> Any:
    """Read a posterior that was saved, without executing anything from the file.

    A file may hold objects of classes that are known to be harmless: networks,
    distributions and transforms of torch, nflows, zuko and sbi, and classes of this
    package. All others have to be named. The posterior is on the CPU, wherever it was
    when it was saved; ``posterior.to("cuda")`` moves it.

    Args:
        path: The file.
        trusted: Your own classes and functions that the posterior needs, such as the
            class of an embedding net or prior. Their code may run. Name a class only if
            you know where it is from.

    Returns:
        The posterior. Samples with a seed and densities are those of the posterior that
        was saved.

    Raises:
        InvalidInputError: If an argument has the wrong type.
        DataNotFoundError: If there is no such file.
        FileFormatError: If it is not a file of :func:`save`, is damaged, or was written
            by other versions of the packages.
        UntrustedError: If the file needs a class or function that is not known.
    """
    return read_object(_path(path), trusted_names(trusted), NeuralPosterior)


def write_object(root: Any, path: Path) -> None:
    """Write an object to a file, and replace the file if there is one.

    Args:
        root: The object, whose classes are those of posteriors and their parts.
        path: The file.

    Raises:
        InvalidInputError: If it holds something that cannot be described.
        NotWritableError: If the file cannot be written.
    """
    described = Description(root)
    memory, tensors = packed(described.tensors)
    description = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "versions": versions_of(described.packages),
        "objects": described.objects,
        "tensors": tensors,
    }
    text = json.dumps(description, separators=(",", ":")).encode()
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file, description=np.frombuffer(text, np.uint8), memory=memory
        )


def read_object(path: Path, trusted: Mapping[str, Any], kind: type) -> Any:
    """Read an object that :func:`write_object` has written.

    Args:
        path: The file.
        trusted: Classes and functions that the file may name, by their names.
        kind: The class of the object.

    Raises:
        DataNotFoundError: If there is no such file.
        FileFormatError: As in :func:`load`.
        UntrustedError: As in :func:`load`.
    """
    if not path.is_file():
        raise DataNotFoundError(f"Expected a file at {path}; got none. Check `path`.")
    description, memory = _read(path)
    try:
        _check_versions(path, description["versions"])
        tensors = list(unpacked(memory, description["tensors"]))
        found = restored(description["objects"], tensors, trusted)
        if not isinstance(found, kind):
            raise TypeError(f"a {type(found).__name__} is no {kind.__name__}")
    except RoPEError:
        raise
    except Exception as error:  # a damaged description may lead to any
        raise FileFormatError(
            f"Expected a whole file of `save`; {path} is damaged "
            f"({type(error).__name__}: {shown(error)}). Get it again."
        ) from error
    return found


def _path(path: Any) -> Path:
    checked = check_path("path", path)
    assert checked is not None
    return checked


def _read(path: Path) -> tuple[dict[str, Any], np.ndarray]:
    """Return the description in a file, and the memory of its tensors."""
    try:
        arrays = read_arrays(path)
        memory = arrays["memory"]
        description = json.loads(arrays["description"].tobytes())
        found = (description["format"], description["format_version"])
        author = description["versions"]["sbi_rope"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FileFormatError(
            f"Expected a whole file of `save`; {path} is none, or is damaged "
            f"({type(error).__name__}). Nothing in it was executed. If it is a "
            "posterior that was pickled, load it as it was written, if you trust its "
            "author, and write it again with `save`."
        ) from error
    if found != (FORMAT, FORMAT_VERSION):
        raise FileFormatError(
            f"Expected a file of format {FORMAT_VERSION}; {path} has format {found[1]}."
            f" Use sbi_rope {author}, which wrote it."
        )
    return description, memory


def versions_of(packages: set[str]) -> dict[str, str]:
    """Return the versions of those packages that a file depends on, by name."""
    used = (name for name in PACKAGES if name in packages | {"sbi_rope", "sbi"})
    return {name: _installed(name) for name in used}


def _installed(package: str) -> str:
    if package == "sbi_rope":  # which is not always installed
        return importlib.import_module(package).__version__
    return importlib.metadata.version(package)


def _check_versions(path: Path, versions: Mapping[str, str]) -> None:
    """Raise unless all packages have the attributes of those that wrote the file."""
    others = {
        name: version
        for name, version in versions.items()
        if name in PACKAGES and _series(version) != _series(_installed(name))
    }
    if others:
        wanted = " ".join(f"'{name}=={_series(v)}.*'" for name, v in others.items())
        here = ", ".join(f"{name} {_installed(name)}" for name in others)
        wrote = ", ".join(f"{name} {version}" for name, version in others.items())
        raise FileFormatError(
            f"{path} was written with {wrote}; here is {here}, whose posteriors may "
            f"have other attributes. Install these versions, `pip install {wanted}`, "
            "or build the posterior and save it again."
        )


def _series(version: str) -> str:
    """Return the part of a version that changes when attributes may change."""
    major, minor = version.split(".")[:2]
    return f"{major}.{minor}" if major == "0" else major
