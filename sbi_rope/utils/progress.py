"""Progress bars, which do not fill log files unless that is asked for."""

import sys
from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm


def is_shown(show_progress_bars: bool | None) -> bool:  # noqa: FBT001
    """Say whether to show progress bars; None shows them where they can be redrawn."""
    if show_progress_bars is not None:
        return bool(show_progress_bars)
    # tqdm has chosen its bar for notebooks, or for terminals, when it was imported.
    in_notebook = any(base.__module__ == "tqdm.notebook" for base in tqdm.__mro__)
    return in_notebook or (sys.stderr is not None and sys.stderr.isatty())


def progress_bar(
    iterable: Iterable[Any] | None = None, *, show: bool, desc: str, **options: Any
) -> Any:
    """Return a bar of tqdm, which is silent unless ``show``."""
    return tqdm(iterable, desc=desc, disable=not show, **options)
