"""Tables of pages, from results that are made up, and from the committed ones."""

import math
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.figures import draw_overview
from benchmarks.pages import BLOCK, BLOCKS, pages_with_blocks, write_pages
from benchmarks.published import FIXED, PAPER, Published
from benchmarks.store import Results
from benchmarks.suites import load_suite
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "benchmarks" / "results"


def published(folder: Path, task: str, runs: list[dict[str, Any]]) -> Published:
    """Make up results of `main` on a task, by repetition.

    Methods have an LPP, "failed", or None if they were not run; -5 if nothing is said.
    """
    results = []
    for cell in load_suite("main").cells:
        if cell.task == task and cell.repetition < len(runs):
            other = (cell.gamma, cell.tau, cell.cost_scale) != FIXED
            name = f"{cell.method}, other" if cell.gamma and other else cell.method
            score = runs[cell.repetition].get(name, -5.0)
            results += [] if score is None else [result_of(cell, score, 0.02)]
    Results(folder / "main").add(results)
    return Published.read(folder)


def line(lines: list[str], start: str) -> list[str]:
    """Return the entries of the first line of a table that starts like this."""
    found = next(part for part in lines if part.startswith(f"| {start} |"))
    return [entry.strip() for entry in found.strip("|").split("|")][1:]


@pytest.mark.slow
def test_committed_pages_are_those_of_the_tables(tmp_path: Path) -> None:
    pages = pages_with_blocks(ROOT)
    copies = [tmp_path / page.relative_to(ROOT) for page in pages]
    for page, copy in zip(pages, copies, strict=True):
        copy.parent.mkdir(parents=True, exist_ok=True)
        # The tables are made by the summary, and not taken from the page.
        copy.write_text(BLOCK.sub(r"\1<!-- /results -->", page.read_text()))
    write_pages(Published.read(COMMITTED), copies)
    for page, copy in zip(pages, copies, strict=True):
        assert copy.read_text() == page.read_text(), page
    texts = "".join(page.read_text() for page in pages)
    assert {*re.findall(r"<!-- results: ([\w-]+) -->", texts)} == {*BLOCKS}


@pytest.mark.medium
def test_the_stack_is_compared_with_the_best_other(tmp_path: Path) -> None:
    lpps = -1.0, -1.2, -1.1
    ours = [{"stack": lpp, "NNPE": -1.5} for lpp in lpps]
    results = published(tmp_path, "cs", ours)
    # Nothing is lost anywhere.
    assert len(BLOCKS["not-the-best"](results)) == 2
    theirs = [{"stack": -1.5, "NNPE": lpp} for lpp in lpps]
    lines = BLOCKS["not-the-best"](published(tmp_path, "cs", theirs))
    row = line(lines, "A cs | 50")
    # 4.303 is Student's quantile of two degrees of freedom.
    gap = f"-0.40 ± {4.303 * 0.1 / 3**0.5:.2f}"
    assert row[1:] == ["3", "-1.50", "+0.020", "NNPE", "-1.10", gap]


def test_methods_that_see_more_are_counted_apart(tmp_path: Path) -> None:
    def counts(**lpp: float) -> list[str]:
        goals = BLOCKS["goals"](published(tmp_path, "cs", [lpp, lpp]))
        assert "|ACAUC| of 0.020" in goals[5]
        return [goal.split(": ")[-1] for goal in goals[1:5]]

    lpp = {"stack": -1.0, "RVNP": -0.5, "NPE": -0.8}
    assert counts(**lpp) == ["0 of 3"] * 3 + ["3 of 3"]
    lpp |= {"NPE": -1.5}
    assert counts(**lpp) == ["0 of 3", "3 of 3", "3 of 3", "3 of 3"]
    lpp |= {"RVNP": -1.5, "Regression": -0.8}
    assert counts(**lpp) == ["0 of 3"] * 3 + ["3 of 3"]


@pytest.mark.medium
def test_the_best_has_all_repetitions_and_the_fixed_setting(tmp_path: Path) -> None:
    usual = {"NPE": -1.0, "SBI": 0.0, "RoPE": -2.0, "RoPE, other": -0.5}
    first = usual | {"FMCPE": -0.1, "prior": -math.inf, "NNPE": None}
    runs = [first, usual | {"FMCPE": -0.1}, usual | {"FMCPE": "failed"}]
    lines = BLOCKS["scores"](published(tmp_path, "cs", runs))
    assert line(lines, "NPE")[0] == "**-1.00**"
    assert line(lines, "FMCPE")[0] == "-0.10 (1 of 3 failed)"
    assert line(lines, "NNPE")[0] == "-5.00 [2]"
    assert line(lines, "prior")[0] == "-inf"
    assert line(lines, "RoPE")[0] == "-2.00"
    assert line(lines, f"RoPE ({PAPER})")[0] == "-0.50"
    # The mean |ACAUC| and seconds.
    assert line(lines, "stack")[-2:] == ["0.020", "0"]


def test_methods_that_were_not_run_again_compete_but_are_not_shown(
    tmp_path: Path,
) -> None:
    results = published(tmp_path, "cs", [{}])
    cells = load_suite("earlier").cells
    old = [cell for cell in cells if (cell.method, cell.n_calibration) == ("J-NPE", 50)]
    Results(tmp_path / "earlier").add([result_of(old[0], -1.0)])
    results = Published.read(results.folder)
    assert "J-NPE" not in "".join(BLOCKS["scores"](results))
    assert line(BLOCKS["not-the-best"](results), "A cs | 50")[4] == "J-NPE †"


@pytest.mark.medium
def test_readme_shows_scores_with_their_intervals(tmp_path: Path) -> None:
    runs = [
        {"stack": -1.0, "RoPE": -3.0, "FMCPE": -6.0},
        {"stack": -1.2, "RoPE": None, "FMCPE": -6.0},
        {"stack": -1.1, "RoPE": None, "FMCPE": "failed"},
    ]
    lines = BLOCKS["readme"](published(tmp_path, "light_tunnel_sensors", runs))
    stack = "-1.10 ± 0.25 (3)"  # 4.303 * 0.1 / sqrt(3)
    assert line(lines, "**`stack`**") == [stack, stack, stack, "+0.020"]
    # Of one repetition the interval is over its test observations.
    assert line(lines, "RoPE")[:2] == ["-3.00 ± 0.20 (1)"] * 2
    assert line(lines, "FMCPE")[0] == "-6.00 ± 0.00 (2; 1 failed)"


@pytest.mark.medium
def test_what_was_run_is_drawn_and_counted_on_a_page(tmp_path: Path) -> None:
    results = published(tmp_path, "cs", [{"RVNP": "failed"}])
    draw_overview(results, tmp_path / "benchmark.png")
    assert (tmp_path / "benchmark.png").exists()
    page = tmp_path / "page.md"
    begin, end = "<!-- results: what-was-run -->\n", "<!-- /results -->\n"
    page.write_text(f"before\n{begin}old\n{end}after\n")
    write_pages(results, [page])
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after")
    assert "old" not in lines
    cells = load_suite("main").cells
    done, failed, missing = next(
        text for text in lines if text.startswith("- main")
    ).split("; ")
    assert failed == "failed: RVNP 1"
    counts = [int(text.rsplit(" ", 1)[1]) for text in missing.split(", ")]
    assert "FMCPE 87" in missing
    assert done == f"- main: {len(cells) - 1 - sum(counts)} of {len(cells)} cells"
