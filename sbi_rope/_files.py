<<<<<<< HEAD
"""Write files completely or not at all, and read arrays."""
=======
"""Write files completely or not at all."""
>>>>>>> review-saving

import contextlib
import secrets
from collections.abc import Iterator
from pathlib import Path

<<<<<<< HEAD
import numpy as np

__all__ = ["read_arrays", "write_atomically"]

# What numpy and zipfile raise for a file that is cut off or is no archive of arrays.
# They raise an AttributeError for a file with a single array.
BROKEN = (
    *(OSError, ValueError, KeyError, EOFError, AttributeError, NotImplementedError),
    *(RuntimeError, zipfile.BadZipFile, zlib.error),
)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file. No code that the file may hold is executed.

    Raises:
        ValueError: If the file is no npz file or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except BROKEN as error:
        raise ValueError(
            f"expected whole arrays; got {type(error).__name__}: {error}"
        ) from error
=======
__all__ = ["write_atomically"]
>>>>>>> review-saving


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and move the file written there to ``path`` at the end.

    A reader never finds half a file under ``path``, also if another process writes the
    same file. If ``path`` is a link, what it points to is replaced.
    """
    path = path.resolve()
    # Files made by `mkstemp` can be read by their owner only.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
