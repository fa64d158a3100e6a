"""Committed tables: that they are read as they were written, and by nobody changed."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from benchmarks.blocks import BLOCK, pages_with_blocks
from benchmarks.cells import Suite, load_suite
from benchmarks.claims import claims, missing_claims
from benchmarks.figures import curves
from benchmarks.published import Published
from benchmarks.report import write_report
from benchmarks.store import Results
from benchmarks.summary import write_summary
from benchmarks.table import read_table, restore_cells, write_table
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
    for name in ("lpp_z", "acauc", "status", "converged", "n_test", "gamma", "tau"):
        pd.testing.assert_series_equal(read.rows[name], table.rows[name])
    for cell, parts in table.arrays.items():
        for name, values in parts.items():
            assert np.array_equal(read.arrays[cell][name], values)
    manifest = json.loads((written / "again" / "manifest.json").read_text())
    counts = [manifest[status] for status in ("finished", "failed", "not run")]
    assert counts == [38, 4, 42]


def test_restored_cells_are_those_of_the_table_and_replace_nothing(
    suite: Suite, written: Path, tmp_path: Path
) -> None:
    table = read_table(suite, written / suite.name)
    finished = [*table.finished.index]
    results = Results(tmp_path / "cells")
    row, arrays = Results(written / "cells").load(finished[0]) or ({}, {})
    results.write(finished[0], row | {"git_commit": "mine"}, arrays)
    assert restore_cells(table, results) == len(table.rows) - 1
    again = write_table(suite, results, tmp_path / "again")
    assert again.statuses(suite.cells).count("failed") == 4
    expected = table.rows.copy()
    expected.loc[finished[0], "git_commit"] = "mine"
    # A cell without an error has none in its file, and an empty text in a table.
    pd.testing.assert_frame_equal(again.rows.fillna(""), expected.fillna(""))
    for cell in finished:
        for name, values in table.arrays[cell].items():
            assert np.array_equal(again.arrays[cell][name], values)


Lines = list[list[str]]


def change(row: int, column: str, text: str) -> Callable[[Lines], Any]:
    return lambda lines: lines[row].__setitem__(lines[0].index(column), text)


# What is done to the file, and what the message says. Row 6 is OT-only's first; the
# first four are the prior's and MLP's.
EDITS: list[tuple[Callable[[Lines], Any], str]] = [
    # As a spreadsheet writes it.
    (
        change(6, "converged", "TRUE"),
        "row 7: column converged: expected True or False; got 'TRUE'",
    ),
    (
        change(6, "lpp_z", "-1.9"),
        r"row 7 \(.*OT-only.*\): column lpp_z: expected -2, .*; got -1.9",
    ),
    (
        change(6, "lpp_z", "-2,0"),
        "row 7: column lpp_z: expected a number.*; got '-2,0'",
    ),
    (change(6, "lpp_z", "nan"), "row 7: column lpp_z: expected a number.*; got nan"),
    (change(6, "acauc", "0.03"), "row 7 .*column acauc: expected"),
    (
        change(6, "expected_coverage_error", "0.001"),
        "row 7 .*column expected_coverage_error: expected",
    ),
    (change(6, "stand_in", "True"), "row 7 .*column stand_in"),
    (
        change(6, "n_test", ""),
        "row 7: column n_test: expected a whole number.*; got None",
    ),
    (change(6, "method", "prior"), "row 7: .* is no cell of the suite tiny"),
    (change(6, "suite", "main"), "row 7: column suite: expected tiny; got 'main'"),
    (
        change(6, "status", "failed"),
        "row 7: column error: expected text that is not empty",
    ),
    (
        change(6, "status", "done"),
        "row 7: column status: expected finished or failed; got 'done'",
    ),
    (change(0, "lpp_z", "LPP"), "expected the columns suite, "),
    (
        lambda lines: lines.append(lines[6]),
        r"row 44: .*OT-only.* is in row 7 already",
    ),
    (
        lambda lines: lines.pop(6),
        "the row of .*OT-only.* is missing; its arrays are there",
    ),
    (
        lambda lines: lines.pop(3),
        "expected 4 rows with status failed, as manifest.json says; got 3",
    ),
    (lambda lines: lines[6].pop(), "row 7: expected 36 entries"),
    # No array tells this one.
    (change(6, "seconds_test", "1.5"), "changed by hand: its checksum"),
]


def test_a_table_that_was_edited_by_hand_is_refused(suite: Suite, out: Path) -> None:
    path = out / "results.csv"
    content = path.read_bytes()
    for edit, message in EDITS:
        path.write_bytes(content)
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


def test_a_damaged_table_is_refused_with_a_way_on(suite: Suite, out: Path) -> None:
    for name in ("results.csv", "arrays.npz", "manifest.json"):
        content = (out / name).read_bytes()
        for damage in (truncate, empty, fill_with_garbage):
            damage(out / name)
            with pytest.raises(InvalidInputError, match=r"Write it again with `python"):
                read_table(suite, out)
            (out / name).write_bytes(content)
    (out / "arrays.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"arrays\.npz is missing"):
        read_table(suite, out)


ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "benchmarks" / "results"


NAMES = sorted(path.parent.name for path in COMMITTED.glob("*/results.csv"))


@pytest.fixture(scope="module")
def published() -> Published:
    return Published.read(COMMITTED)


@pytest.mark.medium
def test_the_committed_tables_fit_their_arrays(published: Published) -> None:
    assert [*published.tables] == NAMES
    assert all(len(table.rows) for table in published.tables.values())


@pytest.mark.slow
def test_the_legend_of_the_suite_with_the_most_methods_is_not_cut_off(
    published: Published,
) -> None:
    table = published.tables["main"]
    figure = curves("n_calibration", table.finished)
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    assert len(legend.texts) > 25
    drawn, whole = legend.get_window_extent(), figure.bbox
    assert drawn.ymin >= whole.ymin
    assert drawn.ymax <= whole.ymax
    assert drawn.xmax <= whole.xmax


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_committed_reports_are_those_of_the_tables(
    name: str, published: Published, tmp_path: Path
) -> None:
    path = write_report(published.suites[name], published.tables[name], tmp_path)
    assert path.read_bytes() == (COMMITTED / name / "report.md").read_bytes()


@pytest.mark.slow
def test_committed_pages_and_blocks_are_those_of_the_tables(tmp_path: Path) -> None:
    folder = tmp_path / "benchmarks" / "results"
    shutil.copytree(COMMITTED, folder)
    pages = pages_with_blocks(ROOT)
    assert len(pages) > 3
    copies = [tmp_path / page.relative_to(ROOT) for page in pages]
    for page, copy in zip(pages, copies, strict=True):
        copy.parent.mkdir(parents=True, exist_ok=True)
        # The block is made by the summary, and not taken from the page.
        copy.write_text(re.sub(r"\n\|.*", "", page.read_text()))
    summary = write_summary(folder, pages=copies)
    assert summary.read_bytes() == (COMMITTED / "README.md").read_bytes()
    for page, copy in zip(pages, copies, strict=True):
        blocks = [BLOCK.findall(path.read_text()) for path in (page, copy)]
        assert blocks[0] == blocks[1], page


@pytest.mark.medium
def test_sentences_that_count_say_what_the_tables_say(
    published: Published, tmp_path: Path
) -> None:
    found = claims(published)
    assert missing_claims(found, ROOT) == []
    for page in {claim.page for claim in found}:
        copy = tmp_path / page
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text((ROOT / page).read_text().replace("within 0.1", "within 0.2"))
    outdated = missing_claims(found, tmp_path)
    assert outdated == [claim for claim in found if "within 0.1" in claim.text]
    assert 0 < len(outdated) < len(found)
