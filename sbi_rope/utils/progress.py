"""Progress bars, which do not fill log files unless that is asked for."""

import sys
from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm

# A bar is drawn again after so many seconds at the earliest. In a file every drawing
# stays, so that there are fewer of them.
SECONDS_ON_SCREEN, SECONDS_IN_FILE = 0.1, 10.0


def is_shown(show_progress_bars: bool | None) -> bool:  # noqa: FBT001
    """Say whether to show progress bars; None shows them where they can be redrawn."""
    return _can_redraw() if show_progress_bars is None else bool(show_progress_bars)


def progress_bar(
    iterable: Iterable[Any] | None = None, *, show: bool, desc: str, **options: Any
) -> Any:
    """Return a bar of tqdm, which is silent unless ``show``."""
    seconds = SECONDS_ON_SCREEN if _can_redraw() else SECONDS_IN_FILE
    return tqdm(iterable, desc=desc, disable=not show, mininterval=seconds, **options)


def _can_redraw() -> bool:
    # tqdm has chosen its bar for notebooks, or for terminals, when it was imported.
    if any(base.__module__ == "tqdm.notebook" for base in tqdm.__mro__):
        return True
    isatty = getattr(sys.stderr, "isatty", None)
    return isatty is not None and isatty()
