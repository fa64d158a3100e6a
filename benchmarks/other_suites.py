"""What the suites beside `main` say, a small table each."""

import json
from collections.abc import Callable, Iterable, Sequence

from benchmarks.cells import NEEDS_CALIBRATION
from benchmarks.published import (
    MISSING,
    SIZE,
    Published,
    Row,
    both_texts,
    entry,
    gap,
    lpp_text,
    name_of,
    table,
)

__all__ = ["other_suites"]


def other_suites(published: Published) -> list[str]:
    """Return a small table of each suite that one is defined for, and that has rows."""
    tables = {
        "gamma": (_gamma, f"RoPE, {SIZE} pairs, by gamma: LPP (ACAUC)."),
        "tau": (_tau, f"RoPE, {SIZE} pairs, by tau: LPP (ACAUC)."),
        "wellspecified": (_well_specified, "RoPE above NPE, by calibration pairs."),
        "labels": (_labels, f"LPP with {SIZE} pairs, by noise on their labels in %."),
    }
    lines = []
    for name, (of_suite, what) in tables.items():
        rows = published.rows[name]
        lines += ["", f"### {published.suites[name].title}", ""]
        lines += [what, "", *of_suite(published, rows)] if rows else ["Not run."]
    return lines


def _grid(
    rows: Iterable[Row],
    *,
    line: Callable[[Row], str],
    column: Callable[[Row], float],
    text: Callable[[Sequence[Row]], str] = both_texts,
) -> list[str]:
    grid: dict[str, dict[float, list[Row]]] = {}
    for row in rows:
        grid.setdefault(line(row), {}).setdefault(column(row), []).append(row)
    columns = sorted({value for entries in grid.values() for value in entries})
    lines = [
        [name, *(entry(entries.get(value, []), text) for value in columns)]
        for name, entries in grid.items()
    ]
    return table(("", *(f"{value:g}" for value in columns)), lines)


def _label(published: Published, row: Row, what: str, *methods: str) -> str:
    """Name a line, with the LPP of other methods on the same data."""
    same = {name: row[name] for name in ("task", "variant", "options")}
    lpps = [
        f"{name} {entry(published.select(name, suite=row['suite'], **same), lpp_text)}"
        for name in methods
    ]
    name = name_of(published, row["task"], suite=row["suite"])
    return f"{name}, {what}" + (f" ({', '.join(lpps)})" if lpps else "")


def _gamma(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        unit = "embedding" if row["cost_scale"] == "none" else "median distance"
        return _label(published, row, f"in units of the {unit}", "prior", "SBI")

    chosen = [r for r in rows if r["method"] == "RoPE" and r["n_calibration"] == SIZE]
    return _grid(chosen, line=line, column=lambda row: row["gamma"])


def _tau(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        weight = json.loads(row["options"]).get("misspecification_weight")
        what = "prior shifted" if weight is None else f"weight {weight:g}"
        return _label(published, row, what, "prior", "NPE")

    chosen = [row for row in rows if row["method"] == "RoPE"]
    return _grid(chosen, line=line, column=lambda row: row["tau"])


def _well_specified(published: Published, rows: list[Row]) -> list[str]:
    def line(row: Row) -> str:
        return _label(published, row, f"tau {row['tau']:g}", "prior", "NPE")

    def text(part: Sequence[Row]) -> str:
        task = part[0]["task"]
        npe = published.select("NPE", suite="wellspecified", task=task)
        difference = gap(part, npe)
        return MISSING if difference is None else f"{difference:+.2f}"

    chosen = [row for row in rows if row["method"] == "RoPE"]
    return _grid(chosen, line=line, column=lambda r: r["n_calibration"], text=text)


def _labels(published: Published, rows: list[Row]) -> list[str]:
    return _grid(
        [row for row in rows if row["method"] in NEEDS_CALIBRATION],
        line=lambda row: _label(published, row, row["method"]),
        column=lambda row: 100 * json.loads(row["options"]).get("label_noise", 0.0),
        text=lpp_text,
    )
