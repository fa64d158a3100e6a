"""Committed tables: that they are read as they were written, and by nobody changed."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.cells import Suite, load_suite
from benchmarks.report import write_report
from benchmarks.store import Results
from benchmarks.tables import read_table, write_table
from sbi_rope.errors import InvalidInputError
from tests.results import SUITE, empty, fill_with_garbage, truncate, write_results


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    path = tmp_path_factory.mktemp("suite") / "tiny.toml"
    path.write_text(SUITE)
    return load_suite(str(path))


@pytest.fixture(scope="module")
def written(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    results = write_results(suite, folder / "cells")
    write_table(suite, results, folder / suite.name)
    return folder


@pytest.fixture
def out(suite: Suite, written: Path, tmp_path: Path) -> Path:
    """A copy of a table, to be changed."""
    return Path(shutil.copytree(written / suite.name, tmp_path / "out"))


def test_a_table_survives_being_written_and_read(suite: Suite, written: Path) -> None:
    table = write_table(suite, Results(written / "cells"), written / "again")
    read = read_table(suite, written / "again")
    assert list(read.rows) == list(table.rows)
    for cell, row in table.rows.items():
        for name in ("lpp_z", "acauc", "status", "converged", "n_test", "error"):
            empty = "" if name == "error" else None
            assert read.rows[cell][name] == row.get(name, empty), name
        for name, values in table.arrays.get(cell, {}).items():
            assert np.array_equal(read.arrays[cell][name], values)
    manifest = json.loads((written / "again" / "manifest.json").read_text())
    assert manifest["not run"] == 42
    assert manifest["failed"] == 4
    assert manifest["finished"] == 38


Lines = list[list[str]]


def change(row: int, column: str, text: str) -> Callable[[Lines], Any]:
    return lambda lines: lines[row].__setitem__(lines[0].index(column), text)


# Row 6 of the file is OT-only's first; the first four are the prior's and MLP's.
@pytest.mark.parametrize(
    ("edit", "message"),
    [
        pytest.param(
            change(6, "converged", "TRUE"),
            "row 7: column converged: expected True or False; got 'TRUE'",
            id="a flag as a spreadsheet writes it",
        ),
        pytest.param(
            change(6, "lpp_z", "-1.9"),
            r"row 7 \(.*OT-only.*\): column lpp_z: expected -2, .*; got -1.9",
            id="a better score",
        ),
        pytest.param(
            change(6, "lpp_z", "-2,0"),
            "row 7: column lpp_z: expected a number.*; got '-2,0'",
            id="another decimal sign",
        ),
        pytest.param(
            change(6, "lpp_z", "nan"),
            "row 7: column lpp_z: expected a number.*; got nan",
            id="no score",
        ),
        pytest.param(
            change(6, "acauc", "0.03"), "row 7 .*column acauc: expected", id="acauc"
        ),
        pytest.param(
            change(6, "expected_coverage_error", "0.001"),
            "row 7 .*column expected_coverage_error: expected",
            id="a smaller error",
        ),
        pytest.param(
            change(6, "stand_in", "True"), "row 7 .*column stand_in", id="stand-in"
        ),
        pytest.param(
            change(6, "n_test", ""),
            "row 7: column n_test: expected a whole number.*; got None",
            id="an empty entry",
        ),
        pytest.param(
            change(6, "method", "prior"),
            "row 7: .* is no cell of the suite tiny",
            id="another method",
        ),
        pytest.param(
            change(6, "suite", "main"),
            "row 7: column suite: expected tiny; got 'main'",
            id="another suite",
        ),
        pytest.param(
            change(6, "status", "failed"),
            "row 7: column error: expected text that is not empty",
            id="no longer finished",
        ),
        pytest.param(
            change(6, "status", "done"),
            "row 7: column status: expected finished or failed; got 'done'",
            id="unknown status",
        ),
        pytest.param(
            change(0, "lpp_z", "LPP"), "expected the columns suite, ", id="no column"
        ),
        pytest.param(
            lambda lines: lines.append(lines[6]),
            r"row 44: .*OT-only.* is in row 7 already",
            id="a row twice",
        ),
        pytest.param(
            lambda lines: lines.pop(6),
            "the row of .*OT-only.* is missing; its arrays are there",
            id="a finished row less",
        ),
        pytest.param(
            lambda lines: lines.pop(3),
            "expected 4 rows with status failed, as manifest.json says; got 3",
            id="a failed row less",
        ),
        pytest.param(
            lambda lines: lines[6].pop(), "row 7: expected 36 entries", id="cut row"
        ),
        pytest.param(
            change(6, "seconds_test", "1.5"),
            "changed by hand: its checksum",
            id="what no array tells",
        ),
    ],
)
def test_a_table_that_was_edited_by_hand_is_refused(
    edit: Callable[[Lines], Any],
    message: str,
    suite: Suite,
    out: Path,
) -> None:
    path = out / "results.csv"
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    edit(lines)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    with pytest.raises(InvalidInputError, match=message):
        read_table(suite, out)


def test_other_line_ends_are_no_change(suite: Suite, out: Path) -> None:
    path = out / "results.csv"
    path.write_bytes(path.read_bytes().replace(b"\r\n", b"\n"))
    assert len(read_table(suite, out).rows) == 42


@pytest.mark.parametrize("name", ["results.csv", "arrays.npz", "manifest.json"])
@pytest.mark.parametrize("damage", [truncate, empty, fill_with_garbage])
def test_a_damaged_table_is_refused_with_a_way_on(
    name: str,
    damage: Callable[[Path], None],
    suite: Suite,
    out: Path,
) -> None:
    damage(out / name)
    with pytest.raises(InvalidInputError, match=r"Write it again with `python -m"):
        read_table(suite, out)


def test_a_table_without_its_arrays_is_refused(suite: Suite, out: Path) -> None:
    (out / "arrays.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"arrays\.npz is missing"):
        read_table(suite, out)


COMMITTED = Path(__file__).parents[2] / "benchmarks" / "results"


@pytest.mark.parametrize(
    "name", sorted(path.parent.name for path in COMMITTED.glob("*/results.csv"))
)
def test_the_committed_tables_fit_their_arrays(name: str) -> None:
    assert read_table(load_suite(name), COMMITTED / name).rows


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted(path.parent.name for path in COMMITTED.glob("*/results.csv"))
)
def test_the_committed_reports_are_those_of_the_tables(
    name: str, tmp_path: Path
) -> None:
    suite = load_suite(name)
    path = write_report(suite, read_table(suite, COMMITTED / name), tmp_path)
    assert path.read_bytes() == (COMMITTED / name / "report.md").read_bytes()
