"""Progress bars that are shown in terminals and notebooks only."""

from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm

__all__ = ["progress_bar"]


def progress_bar(
    iterable: Iterable[Any] | None = None, *, show: bool, desc: str, **options: Any
) -> Any:
    """Return a tqdm bar, which is silent unless ``show`` and stderr is a terminal.

    In a log file every refresh would add a line. Notebooks show bars as terminals do.

    Args:
        iterable: What to iterate over; None for a bar that is updated by hand.
        show: Whether to show the bar.
        desc: The name of the bar.
        **options: Other arguments of tqdm.
    """
    return tqdm(iterable, desc=desc, disable=None if show else True, **options)
