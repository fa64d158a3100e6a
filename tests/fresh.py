"""Import the package anew in this process, because a new interpreter takes seconds."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["imported_anew"]

PACKAGE = "sbi_rope"


@contextmanager
def imported_anew(*, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Forget the modules of the package inside a ``with`` block.

    Imports in the block make a second copy. After it the first copy is back.

    Args:
        without: Names of modules whose import fails in the block.
    """
    known = dict(sys.modules)
    for name in list(sys.modules):
        if name.split(".")[0] == PACKAGE:
            del sys.modules[name]
    sys.modules.update(dict.fromkeys(without))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in list(sys.modules):
            if name.split(".")[0] == PACKAGE or name in without:
                del sys.modules[name]
        missing = known.keys() - sys.modules.keys()
        sys.modules.update({name: known[name] for name in missing})
