"""Tables of pages, from results that are made up, and from the committed ones."""

import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.cells import Cell, load_suite
from benchmarks.figures import draw_overview, rank_figure
from benchmarks.pages import (
    BLOCK,
    BLOCKS,
    number_text,
    pages_with_blocks,
    write_pages,
)
from benchmarks.published import FIXED, Published, against_candidates, relative_ranks
from benchmarks.store import Result, Results
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "benchmarks" / "results"
# A cell to its LPP, or None if it was not run, or "failed".
Scores = Callable[[Cell], float | str | None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "results"


def published(folder: Path, scores: Scores, suite: str = "main") -> Published:
    """Make up the results of a suite."""
    cells = load_suite(suite).cells
    made = {cell: scores(cell) for cell in cells}
    Results(folder / suite).add(
        result_of(cell, score, 0.02)
        for cell, score in made.items()
        if score is not None
    )
    return Published.read(folder)


def on_cs(by_repetition: dict[int, dict[str, float | str]]) -> Scores:
    """Scores of methods on cs by repetition; -5 if nothing is said."""

    def scores(cell: Cell) -> float | str | None:
        known = by_repetition.get(cell.repetition)
        if cell.task != "cs" or known is None:
            return None
        other = (cell.gamma, cell.tau, cell.cost_scale) != FIXED
        name = f"{cell.method}, other" if cell.gamma and other else cell.method
        return known.get(name, -5.0)

    return scores


def line(lines: list[str], start: str) -> list[str]:
    """Return the entries of the first line of a table that starts like this."""
    found = next(part for part in lines if part.startswith(f"| {start} |"))
    return [entry.strip() for entry in found.strip("|").split("|")][1:]


# The committed pages ------------------------------------------------------------------


@pytest.mark.slow
def test_committed_pages_are_those_of_the_tables(tmp_path: Path) -> None:
    pages = pages_with_blocks(ROOT)
    assert len(pages) > 3
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


def test_a_page_without_whole_places_is_refused_and_not_written(folder: Path) -> None:
    results = published(folder, on_cs({0: {}}))
    page = folder / "page.md"
    begin, end = "<!-- results: costs -->\n", "<!-- /results -->\n"
    unknown = "<!-- results: unheard-of -->\n" + end
    for text in (end + begin, begin + begin + end, begin + end + end, unknown):
        page.write_text(text)
        with pytest.raises(SystemExit, match=r"page\.md: expected places"):
            write_pages(results, [page])
        assert page.read_text() == text
    page.write_text(f"before\n{begin}old\n{end}after\n")
    write_pages(results, [page])
    assert re.fullmatch(rf"before\n{begin}\|.*\|\n{end}after\n", page.read_text(), re.S)
    assert "old" not in page.read_text()


def test_a_folder_without_results_is_refused(folder: Path) -> None:
    with pytest.raises(SystemExit, match="No results in"):
        Published.read(folder)


# The stack against all others ---------------------------------------------------------


@pytest.mark.medium
def test_the_stack_is_compared_with_the_best_other_on_the_same_repetitions(
    folder: Path,
) -> None:
    scores = {0: -1.0, 1: -1.2, 2: -1.1}
    runs = {i: {"stack": lpp, "J-NPE": -1.5} for i, lpp in scores.items()}
    results = published(folder, on_cs(runs))
    row = line(BLOCKS["stack"](results), "A cs | 50")
    # 4.303 is Student's quantile of two degrees of freedom.
    width = 4.303 * 0.1 / 3**0.5
    assert row[1:4] == ["3", "-1.10", "+0.020"]
    assert row[4:7] == ["J-NPE", "-1.50", f"+0.40 ± {width:.2f}"]
    goals = "\n".join(BLOCKS["goals"](results))
    assert "best other beyond the interval over repetitions: 3 of 3" in goals
    # Nothing is lost anywhere.
    assert len(BLOCKS["not-the-best"](results)) == 2


def test_methods_that_see_more_and_those_of_this_package_are_counted_apart(
    folder: Path,
) -> None:
    lpp = {"stack": -1.0, "RVNP": -0.5, "discrepancy": -1.0, "J-NPE": -1.5, "NPE": -0.8}
    results = published(folder, on_cs({0: lpp, 1: lpp}))
    goals = BLOCKS["goals"](results)
    assert goals[1] == "- best, or within 0.1 nats of the best: 0 of 3"
    assert goals[2].endswith("of those that see no more data: 0 of 3")
    assert goals[5] == "- not more than 0.1 nats below the prior or NPE: 0 of 3"
    assert goals[6].endswith(
        "|ACAUC| of 0.020 over tasks, pairs and repetitions "
        "(aimed at 0.03; SBI has 0.020 on these tasks)"
    )
    row = line(BLOCKS["not-the-best"](results), "A cs | 10")
    assert row[4:7] == ["RVNP", "-0.50", "-0.50 ± 0.00"]
    lpp |= {"RVNP": -1.5, "NPE": -1.5}
    goals = BLOCKS["goals"](published(folder, on_cs({0: lpp, 1: lpp})))
    assert goals[1:4] == [
        "- best, or within 0.1 nats of the best: 3 of 3",
        "- best, or within 0.1 nats of the best of those that see no more data: 3 of 3",
        "- better than the best other beyond the interval over repetitions: 0 of 3",
    ]
    assert goals[4].endswith("not of this package: 3 of 3")


def test_a_stack_is_compared_with_its_best_candidate(folder: Path) -> None:
    cell = Cell(task="pendulum", method="stack", n_calibration=10)
    row, _ = result_of(cell, -1.2)
    arrays = {
        "candidates": np.array(["prior", "NPE", "RoPE", "stack"]),
        "test": np.array([-3.0, -9.0, -1.5]),
        "held_out": np.array([-3.1, -8.0, -1.0, -1.7]),
        "held_out_error": np.array([0.0, 0.0, 0.0, 0.2]),
    }
    results = Results(folder / "stacking")
    results.add([Result(row, arrays)])
    (found,) = against_candidates(results).to_dict("records")
    assert found == pytest.approx(
        {"size": 10, "best": 0.3, "basics": 1.8, "held_out": 2.5}
    )
    assert line(BLOCKS["candidates"](Published.read(folder)), "10") == [
        *("1", "1", "1", "0")
    ]


@pytest.mark.medium
def test_ranks_are_relative_to_what_was_run_and_a_failure_is_the_last() -> None:
    scores = {"stack": -1.0, "NPE": -2.0, "RoPE": None, "J-NPE": -1.5}
    lines = [
        {"task": task, "method": name, "repetition": 0, "lpp_z": score}
        for task in ("cs", "sir")
        for name, score in scores.items()
        if (task, name) != ("sir", "J-NPE")
    ]
    rows = pd.DataFrame(lines).assign(n_calibration=50)
    rows["status"] = np.where(rows["lpp_z"].isna(), "failed", "finished")
    ranks = relative_ranks(rows, beside="stack")
    expected = {"stack": 0.0, "J-NPE": 1 / 3, "NPE": 2 / 3, "RoPE": 1.0}
    assert ranks["cs"].to_dict() == pytest.approx(expected)
    assert ranks["sir"].drop("J-NPE").to_dict() == {"stack": 0, "NPE": 0.5, "RoPE": 1}
    assert math.isnan(ranks["sir"]["J-NPE"])
    assert relative_ranks(rows.assign(n_calibration=1000), beside="stack").empty
    assert rank_figure(ranks).axes[0].get_yticklabels()[1].get_text() == "NPE"


@pytest.mark.medium
def test_the_pictures_of_all_tasks_are_drawn(folder: Path) -> None:
    draw_overview(published(folder, on_cs({0: {"stack": -1.0}})), folder)
    assert {path.name for path in folder.glob("*.png")} == {"methods.png", "ranks.png"}


# Other tables -------------------------------------------------------------------------


@pytest.mark.medium
def test_the_best_has_all_repetitions_and_the_fixed_setting(folder: Path) -> None:
    runs: dict[int, dict[str, float | str]] = {
        i: {"NPE": -1.0, "SBI": 0.0, "RoPE": -2.0, "RoPE, other": -0.5}
        for i in range(3)
    }
    runs[2]["MLP"] = "failed"
    for i in range(2):
        runs[i]["MLP"] = -0.1
    runs[0]["prior"] = -math.inf
    lines = BLOCKS["all-tasks"](published(folder, on_cs(runs)))
    assert line(lines, "NPE") == ["**-1.00 ± 0.00**"]
    assert line(lines, "MLP") == ["-0.10 ± 0.00 (1 of 3 failed)"]
    assert line(lines, "prior") == ["-inf"]
    assert line(lines, "RoPE") == ["-2.00 ± 0.00"]
    assert line(lines, "RoPE (gamma 0.1, tau 0.9)") == ["-0.50 ± 0.00"]


@pytest.mark.medium
def test_readme_shows_scores_on_real_measurements_with_their_intervals(
    folder: Path,
) -> None:
    lpp = {"stack": (-1.0, -1.2, -1.1), "NPE": (-30.0, -30.0, -30.0), "RoPE": (-3.0,)}
    lpp["FMCPE (embedding)"] = -6.0, -6.0, "failed"

    def scores(cell: Cell) -> float | str | None:
        of_run = lpp.get(cell.method, ())
        right = cell.task == "light_tunnel_sensors" and cell.gamma in (None, 0.1)
        if not right or cell.tau not in (None, 1.0) or len(of_run) <= cell.repetition:
            return None
        return of_run[cell.repetition]

    lines = BLOCKS["readme"](published(folder, scores))
    stack = "-1.10 ± 0.25 (3)"  # 4.303 * 0.1 / sqrt(3)
    assert line(lines, "**`stack`**") == [stack, stack, stack, "+0.020"]
    assert line(lines, "NPE as it was")[0] == "-30.00 ± 0.00 (3)"
    # Of one repetition the interval is over its test observations.
    assert line(lines, "RoPE")[:2] == ["-3.00 ± 0.20 (1)"] * 2
    assert line(lines, "FRISBI (distilled)") == ["-"] * 4
    assert line(lines, "FMCPE (embedding)")[0] == "-6.00 ± 0.00 (2; 1 failed)"


@pytest.mark.medium
def test_excerpts_show_means_how_many_repetitions_they_have_and_what_was_not_run(
    folder: Path,
) -> None:
    def scores(cell: Cell) -> float | str | None:
        if cell.task != "cs" or cell.method not in ("NPE", "stack", "MLP"):
            return None
        if cell.method == "stack" and cell.n_calibration == 50 and cell.repetition == 2:
            return "failed"
        if cell.method == "stack" and cell.n_calibration == 10 and cell.repetition:
            return None
        return -1.5 - cell.repetition

    results = published(folder, scores)
    lines = BLOCKS["stack-and-others"](results)
    assert line(lines, "NPE")[:2] == ["-2.50", "-"]
    assert line(lines, "stack")[0] == "-2.00 (1 of 3 failed)"
    assert line(lines, "RoPE") == ["-"] * 6
    calibration = line(BLOCKS["calibration"](results), "cs")
    assert calibration[1:3] == ["0.02", "-"]
    assert calibration[4] == "0.02 [1] / 0.02 (1 of 3 failed) / 0.02"


@pytest.mark.medium
def test_where_rope_loses_is_listed_with_the_best_other(folder: Path) -> None:
    runs = {0: {"RoPE": -2.0, "prior": -1.5, "MLP": -1.0, "SBI": 0.0, "stack": 0.0}}
    lines = BLOCKS["rope-losses"](published(folder, on_cs(runs)))
    assert line(lines, "A cs | 50") == ["50", "-2.00", "-0.50", "", "-1.00 MLP"]
    lines = BLOCKS["rope-losses"](published(folder, on_cs({0: {"RoPE": -0.5}})))
    assert len(lines) == 2


def test_a_grid_has_a_line_for_each_task_and_a_column_for_each_setting(
    folder: Path,
) -> None:
    def scores(cell: Cell) -> float | str | None:
        if cell.task != "pendulum" or cell.method == "OT-only":
            return None
        if cell.method != "RoPE":
            return {"prior": -3.0, "SBI": 2.0}[cell.method]
        if cell.gamma == 0.01 and cell.repetition == 1:
            return "failed"
        return None if cell.gamma == 10.0 else -(cell.gamma or 0.0)

    lines = BLOCKS["gamma"](published(folder, scores, "gamma"))
    start = (
        "C pendulum, in units of the embedding (prior -3.00 ± 0.00, SBI 2.00 ± 0.00)"
    )
    row = dict(
        zip(lines[0].strip("|").split(" | ")[1:], line(lines, start), strict=False)
    )
    assert row["0.01"] == "-0.01 (+0.02) (1 of 3 failed)"
    assert "-1.00 (+0.02)" in row.values()
    assert len(lines) == 4


def test_a_mean_with_one_infinity_is_infinite_and_has_no_spread() -> None:
    assert number_text(pd.Series([-1.0, -math.inf]), ".2f") == "-inf"
    assert number_text(pd.Series([1.0, 3.0]), "+.2f") == "+2.00 ± 1.41"
    assert number_text(pd.Series([1.0]), ".2f") == "1.00"


def test_what_was_run_is_counted(folder: Path) -> None:
    results = published(folder, on_cs({0: {"MLP": "failed"}}))
    shutil.rmtree(folder)
    row = line(BLOCKS["what-was-run"](results), "[main](main/report.md)")
    mlp = len({cell for cell in load_suite("main").cells if cell.method == "MLP"})
    assert mlp
    assert row[1] == "4"
    assert int(row[0]) + int(row[1]) + int(row[2]) == len(load_suite("main").cells)
    assert row[3].startswith("cs 1/3, ")
