"""Results as tables of pandas, which need not be installed."""

from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["as_dataframe"]


def as_dataframe(rows: Iterable[Mapping[str, Any]]) -> Any:
    """Return rows as a table of pandas.

    Raises:
        ImportError: If pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise ImportError(
            "pandas is not installed. Run `pip install pandas`, or use `as_rows()`."
        ) from error
    return pandas.DataFrame(list(rows))
