"""Checks of tables whose columns and rows have names, such as dataframes of pandas.

Tables are read as arrays, which have no names. The same columns or rows in another
order would be taken for each other.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

from sbi_rope.errors import InvalidInputError

__all__ = [
    "KnownColumns",
    "check_columns",
    "check_parameter_order",
    "check_row_order",
    "check_simulated_columns",
    "check_tables",
    "column_names",
    "columns_of",
    "joined_columns",
]

# The names of columns in orders that are known to be right, and where each comes from.
KnownColumns = Mapping[tuple[Hashable, ...], str]
# Of more columns the first that is in the wrong place is named, and not all of them.
MOST_LISTED = 10


def column_names(table: Any) -> tuple[str, ...]:
    """Return the names of the columns of a table, or of the entries of a series.

    There are none if two are equal, or one is no string, and none of a tensor.
    """
    names = _labels_of(table, "columns") or _labels_of(table, "index")
    if len(set(names)) < len(names) or not all(isinstance(n, str) for n in names):
        return ()
    return tuple(str(name) for name in names)


def _labels_of(table: Any, axis: str) -> tuple[Hashable, ...]:
    """Return the labels of an axis of a table, whatever they are; none of an array."""
    found = getattr(table, axis, None)
    if callable(found) or not isinstance(found, Iterable):
        return ()
    # Pandas has numbers of NumPy, which would be printed with their type.
    to_list = getattr(found, "tolist", None)
    return tuple(found if to_list is None else to_list())


def check_row_order(**tables: Any) -> None:
    """Raise if the rows of two tables have the same labels in different orders.

    Rows are paired by their position, so that they would be paired wrongly.

    Args:
        tables: What the user gave, of any type.

    Raises:
        InvalidInputError: If the order is another one.
    """
    known: tuple[str, tuple[Hashable, ...]] | None = None
    for name, table in tables.items():
        rows = _labels_of(table, "index")
        if known is None:
            known = (name, rows) if rows else None
            continue
        first, expected = known
        if rows == expected or len(rows) != len(expected):
            continue
        if Counter(rows) == Counter(expected):
            row = next(k for k, label in enumerate(rows) if label != expected[k])
            raise InvalidInputError(
                f"Expected `{first}` and `{name}` with their rows in the same order, "
                f"because they are paired by position; got row {expected[row]!r} of "
                f"`{first}` and row {rows[row]!r} of `{name}` in place {row}. Pass "
                f"`{name}.loc[{first}.index]`, or `{name}.to_numpy()` if the labels "
                "of the rows mean nothing."
            )


def columns_of(posterior: Any) -> dict[str, KnownColumns]:
    """Return the orders of columns of "theta" and "x" that a posterior knows.

    Args:
        posterior: A posterior of any kind, or its set or intervals. Those of this
            package, and those that its trainers made, know them as ``columns``.
    """
    columns = getattr(posterior, "columns", None)
    known = columns if isinstance(columns, Mapping) else {}
    return {name: dict(known.get(name, {})) for name in ("theta", "x")}


def check_parameter_order(names: Sequence[str], known: KnownColumns) -> None:
    """Raise if the names of parameters are known in another order.

    Raises:
        InvalidInputError: If they are.
    """
    for expected, source in known.items():
        if Counter(names) == Counter(expected) and tuple(names) != expected:
            raise InvalidInputError(
                f"Expected `parameter_names` in the order of {source}, which the "
                f"posterior was trained on, {list(expected)}; got {list(names)}."
            )


def check_tables(posterior: Any, **tables: Any) -> None:
    """Raise if a table has columns that a posterior knows in another order.

    Args:
        posterior: As in :func:`columns_of`.
        tables: What the user gave as ``theta`` and ``x``.

    Raises:
        InvalidInputError: If the order of columns is another one.
    """
    known = columns_of(posterior)
    for name, table in tables.items():
        check_columns(name, table, known[name])


def check_columns(
    name: str, table: Any, known: KnownColumns, *, how: str = "df[{0}]"
) -> KnownColumns:
    """Raise if a table has known columns in another order.

    Other names say nothing, because they may be other spellings.

    Args:
        name: What the argument is called.
        table: What the user gave, of any type.
        known: The orders that are known.
        how: Code that puts the columns into the order of a list.

    Returns:
        The orders that are known, with that of this table.

    Raises:
        InvalidInputError: If the order is another one.
    """
    names = _labels_of(table, "columns") or column_names(table)
    return _check_order(
        name, names, known, source=f"the earlier table `{name}`", how=how
    )


def check_simulated_columns(
    names: tuple[str, ...], known: KnownColumns
) -> KnownColumns:
    """Raise if a simulator returns tables with known columns in another order.

    Args:
        names: The names of the columns of its tables; none if it returns arrays.
        known: The orders of columns of x that are known.

    Returns:
        The orders that are known, with that of these tables.

    Raises:
        InvalidInputError: If the order is another one.
    """
    source = "the tables that `simulator` returns"
    return _check_order("simulator(theta)", names, known, source=source, do="Return")


def _check_order(
    name: str,
    names: tuple[Hashable, ...],
    known: KnownColumns,
    *,
    source: str,
    do: str = "Pass",
    how: str = "df[{0}]",
) -> KnownColumns:
    """Raise if names of columns are known in another order; return all orders.

    Args:
        name: What the table is called.
        names: The names of its columns; none of an array.
        known: As in :func:`check_columns`.
        source: Where these names come from.
        do: What to do with a table in the right order.
        how: As in :func:`check_columns`.
    """
    for expected, earlier in known.items():
        if names == expected or Counter(names) != Counter(expected):
            continue
        start = f"Expected `{name}` with its columns in the order of {earlier}"
        if len(names) <= MOST_LISTED:
            raise InvalidInputError(
                f"{start}, {list(expected)}; got {list(names)}. {do} "
                f"`{how.format(list(expected))}`, where `df` is this table."
            )
        pairs = zip(names, expected, strict=True)
        first = next(k for k, (ours, other) in enumerate(pairs) if ours != other)
        raise InvalidInputError(
            f"{start}; got {names[first]!r} in column {first}, where "
            f"{expected[first]!r} is expected. {do} `{how.format('names')}`, where "
            "`df` is this table and `names` is the list of columns in that order."
        )
    if not names or names in known:
        return known
    return {**known, names: source}


def joined_columns(name: str, sources: Sequence[KnownColumns]) -> KnownColumns:
    """Return the orders of columns that several posteriors know.

    Args:
        name: What the argument is called.
        sources: The orders that each posterior knows.

    Raises:
        InvalidInputError: If two know the same columns in different orders.
    """
    joined: dict[tuple[Hashable, ...], str] = {}
    first: dict[frozenset[Any], tuple[Hashable, ...]] = {}
    for order, source in (item for known in sources for item in known.items()):
        # The same names in any order, each as often.
        same = frozenset(Counter(order).items())
        earlier = first.setdefault(same, order)
        if earlier != order:
            raise InvalidInputError(
                f"Expected `posteriors` that know the columns of `{name}` in one "
                f"order; got {list(earlier)} and {list(order)}. Make all of them from "
                "tables with the same order of columns."
            )
        joined.setdefault(order, source)
    return joined
