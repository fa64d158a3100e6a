"""Import the package anew in this process, because a new interpreter takes seconds."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch


@contextmanager
def imported_anew(*, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Import a second copy of the package in a ``with`` block, some modules missing."""
    with patch.dict(sys.modules, dict.fromkeys(without)):  # type: ignore[arg-type]
        for name in list(sys.modules):
            if name.split(".")[0] == "sbi_rope":
                del sys.modules[name]
        yield
