"""Progress bars, for people who watch."""

from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm

__all__ = ["progress_bar"]


def progress_bar(
    iterable: Iterable[Any] | None = None, *, show: bool, desc: str, **options: Any
) -> Any:
    """Return a bar of tqdm, silent unless it is asked for and stderr is a terminal.

    In a log file every refresh would be a line. Notebooks show bars like terminals.

    Args:
        iterable: What to go through; None for a bar that is updated by hand.
        show: Whether to show it.
        desc: What it is called.
        **options: What else tqdm takes.
    """
    return tqdm(iterable, desc=desc, disable=None if show else True, **options)
