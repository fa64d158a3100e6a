"""What the columns of a table hold, in memory and as text."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from benchmarks.cells import Cell

__all__ = ["CELL_COLUMNS", "COLUMNS", "as_text", "check_row", "from_text"]

STATUSES = ("finished", "failed")


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What an entry may be.

    Attributes:
        what: In words, for messages.
        holds: Whether a value is of this kind.
        read: Text to a value; raises ``ValueError`` if it is none.
        optional: Whether the entry may be empty.
    """

    what: str
    holds: Callable[[Any], bool]
    read: Callable[[str], Any]
    optional: bool = False


def _flag_from(text: str) -> bool:
    # Not `text == "True"`: a spreadsheet writes TRUE, which would be read as False.
    if text not in ("True", "False"):
        raise ValueError(text)
    return text == "True"


def _number(
    what: str, low: float, high: float, *, optional: bool = False, nan: bool = False
) -> Kind:
    def holds(value: Any) -> bool:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        return nan if math.isnan(value) else low <= value <= high

    return Kind(what=what, holds=holds, read=float, optional=optional)


def _count(what: str, low: int) -> Kind:
    return Kind(
        what=what,
        holds=lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= low,
        read=int,
    )


TEXT = Kind(what="text", holds=lambda value: isinstance(value, str), read=str)
FILLED = Kind(
    what="text that is not empty",
    holds=lambda value: isinstance(value, str) and value != "",
    read=str,
)
FLAG = Kind(what="True or False", holds=lambda v: isinstance(v, bool), read=_flag_from)
SCORE = _number("a number, or -inf", -math.inf, math.inf)
ERROR = _number("a number that is not negative, or nan", 0, math.inf, nan=True)
SECONDS = _number("a number of seconds", 0, math.inf)

OF_CELLS = {
    "task": FILLED,
    "variant": TEXT,
    "options": FILLED,
    "preset": FILLED,
    "method": FILLED,
    "n_calibration": _count("a whole number from 0 on", 0),
    "gamma": _number("a positive number, or nothing", 0, math.inf, optional=True),
    "tau": _number("a number from 0 to 1, or nothing", 0, 1, optional=True),
    "cost_scale": TEXT,
    "repetition": _count("a whole number from 0 on", 0),
}
# Of a cell that is finished.
OF_RESULTS = {
    "lpp": SCORE,
    "lpp_z": SCORE,
    "lpp_median": SCORE,
    "lpp_standard_error": ERROR,
    "neg_inf_fraction": _number("a number from 0 to 1", 0, 1),
    "acauc": _number("a number from -0.5 to 0.5", -0.5, 0.5),
    "acauc_standard_error": ERROR,
    "acauc_per_parameter": FILLED,
    "expected_coverage_error": _number("a number from 0 to 1", 0, 1),
    "c2st": _number("a number from 0 to 1, or nothing", 0, 1, optional=True),
    "converged": FLAG,
    "n_test": _count("a whole number from 1 on", 1),
    "stand_in": FLAG,
    "seconds_npe": SECONDS,
    "seconds_train": SECONDS,
    "seconds_couple": SECONDS,
    "seconds_test": SECONDS,
    "num_simulations": _count("a whole number from 0 on", 0),
    "peak_memory_mb": ERROR,
    "device": TEXT,
    "versions": TEXT,
    "git_commit": TEXT,
    "finished_at": TEXT,
}
CELL_COLUMNS = tuple(field.name for field in fields(Cell))
COLUMNS = ("suite", *CELL_COLUMNS, "status", *OF_RESULTS, "error")
KINDS = {"suite": FILLED, **OF_CELLS, "status": FILLED, **OF_RESULTS, "error": TEXT}


def check_row(row: Mapping[str, Any], cell: Cell | None = None) -> None:
    """Check the entries of a row.

    Args:
        row: Values by column.
        cell: The cell that it has to belong to.

    Raises:
        ValueError: If one is not what its column holds. It names the column.
    """
    _check(row, OF_CELLS)
    expected = {} if cell is None else asdict(cell)
    for name, value in expected.items():
        if row[name] != value:
            raise ValueError(f"column {name}: expected {value!r}; got {row[name]!r}")
    status = row.get("status")
    if status not in STATUSES:
        raise ValueError(
            f"column status: expected {' or '.join(STATUSES)}; got {status!r}"
        )
    _check(row, OF_RESULTS if status == "finished" else {"error": FILLED})


def _check(row: Mapping[str, Any], kinds: Mapping[str, Kind]) -> None:
    for name, kind in kinds.items():
        value = row.get(name)
        if value is None and kind.optional and name in row:
            continue
        if not kind.holds(value):
            raise ValueError(f"column {name}: expected {kind.what}; got {value!r}")


def as_text(value: Any) -> str:
    """Return an entry as the text of a CSV file."""
    if value is None:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def from_text(name: str, text: str) -> Any:
    """Return the entry of a column from the text of a CSV file; None if it is empty.

    Raises:
        ValueError: If it cannot be read. It names the column.
    """
    kind = KINDS[name]
    if text == "" and kind.read is not str:
        return None
    try:
        return kind.read(text)
    except ValueError as error:
        raise ValueError(
            f"column {name}: expected {kind.what}; got {text!r}"
        ) from error
