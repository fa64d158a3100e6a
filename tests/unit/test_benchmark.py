"""The benchmark's cells, reports and presets, without training anything."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.cells import Cell, Suite, data_in_words, list_suites, load_suite
from benchmarks.figures import LPPAxis, curves
from benchmarks.methods import METHODS
from benchmarks.presets import PRESETS
from benchmarks.report import worse, write_report
from benchmarks.store import Results
from benchmarks.table import Table, number_text, read_table, write_table
from sbi_rope.errors import InvalidInputError
from sbi_rope.tasks import get_task, list_tasks
from tests.results import SUITE, result_of, write_results

pytestmark = pytest.mark.usefixtures("rough_pictures")


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    path = tmp_path_factory.mktemp("suite") / "tiny.toml"
    path.write_text(SUITE)
    return load_suite(str(path))


# Cells and suites -------------------------------------------------------------------


def test_a_suite_lists_every_combination_once_and_under_a_name_of_its_own(
    suite: Suite,
) -> None:
    assert len({cell.key for cell in suite.cells}) == len(suite.cells)
    methods = [cell.method for cell in suite.cells]
    counts = {method: methods.count(method) for method in dict.fromkeys(methods)}
    # Two repetitions and two dimensions; sizes and couplings only where they matter.
    assert counts == {"prior": 4, "MLP": 8, "OT-only": 24, "RoPE": 48}
    # Repetition, dimension, size, cost scale: gamma and tau are computed together.
    groups = {cell.group for cell in suite.cells if cell.method == "RoPE"}
    assert len(groups) == 2 * 2 * 2 * 2
    chosen = suite.select(methods=["prior", "MLP"])
    assert {cell.method for cell in chosen} == {"prior", "MLP"}


def test_the_files_of_finished_cells_keep_their_names() -> None:
    # Results of older versions would be computed again otherwise.
    cell = load_suite("smoke").cells[0]
    assert (cell.method, cell.key) == ("prior", "161da464d9f42938e054")
    assert replace(cell).key == cell.key


def test_the_suites_that_come_along_can_be_read() -> None:
    for suite in map(load_suite, list_suites()):
        assert suite.cells
        assert suite.title
        assert {cell.preset for cell in suite.cells} <= {*PRESETS}
        for cell in suite.cells:
            assert cell.task in (METHODS[cell.method].tasks or (cell.task,))


def test_unknown_names_are_refused_with_the_known_ones(
    suite: Suite, tmp_path: Path
) -> None:
    with pytest.raises(SystemExit, match=r"No suite 'nonsense'; there are .*smoke"):
        load_suite("nonsense")
    with pytest.raises(SystemExit, match=r"No task 'sir' .*linear_gaussian"):
        suite.select(tasks=["sir"])
    with pytest.raises(SystemExit, match=r"No method 'magic' .*RoPE"):
        suite.select(methods=["magic"])
    path = tmp_path / "wrong.toml"
    path.write_text(SUITE.replace("taus", "tau"))
    with pytest.raises(SystemExit, match=r"Unknown key.*'tau'"):
        load_suite(str(path))
    path.write_text(SUITE.replace("OT-only", "magic"))
    with pytest.raises(InvalidInputError, match=r"got 'magic'. There are prior, SBI"):
        load_suite(str(path))
    path.write_text(SUITE.replace('title = "Tiny"', ""))
    with pytest.raises(InvalidInputError, match="title is missing"):
        load_suite(str(path))


def test_an_axis_is_a_setting_of_the_suite_and_never_a_path(tmp_path: Path) -> None:
    path = tmp_path / "axis.toml"
    for axis in ("../../../evil", "/evil", "..", "", "lpp", 3, 'dim"', ".hidden"):
        path.write_text(f"x_axis = {json.dumps(axis)}\n{SUITE}")
        with pytest.raises(InvalidInputError, match="x_axis in"):
            load_suite(str(path))
    path.write_text(f'x_axis = "dim"\n{SUITE}')
    assert load_suite(str(path)).x_axis == "dim"
    text = SUITE.replace("{ dim = [2, 3] }", '{ "../evil" = [2, 3] }')
    path.write_text(f'x_axis = "../evil"\n{text}')
    with pytest.raises(InvalidInputError, match="files are named by it"):
        load_suite(str(path))


@pytest.mark.parametrize("name", ["..", ".hidden", "a b"])
def test_a_suite_whose_name_cannot_be_that_of_a_folder_is_refused(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / f"{name}.toml"
    path.write_text(SUITE)
    with pytest.raises(InvalidInputError, match="Expected the name of"):
        load_suite(str(path))


def test_titles_and_messages_state_options_in_words() -> None:
    options = '{"label_noise": 0.1, "stand_in": true}'
    assert data_in_words("sir", "", options) == ["sir", "label noise 0.1", "stand in"]
    cell = Cell(task="sir", variant="prior_shift", options=options, method="prior")
    assert str(cell) == "sir prior_shift label noise 0.1 stand in prior #0"


def test_ci_expects_as_many_finished_cells_as_the_smoke_suite_has() -> None:
    script = (Path(__file__).parents[2] / ".ci" / "run").read_text()
    cells = load_suite("smoke").cells
    assert f"\nexpected={len(cells)} " in script
    everywhere = {name for name, entry in METHODS.items() if not entry.extra}
    assert {cell.method for cell in cells} == everywhere


def test_no_two_methods_are_drawn_alike() -> None:
    styles = [entry.style for entry in METHODS.values()]
    assert len(set(styles)) == len(styles)


# Reports ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Results for reading only."""
    return write_results(suite, tmp_path_factory.mktemp("results") / "cells")


def report_of(suite: Suite, results: Results, folder: Path) -> str:
    table = write_table(suite, results, folder)
    return write_report(suite, table, folder).read_text()


@pytest.mark.slow
def test_the_same_table_gives_the_same_bytes(
    suite: Suite, results: Results, tmp_path: Path
) -> None:
    table = write_table(suite, results, tmp_path / "out")
    contents = []
    for name in ("first", "second"):
        write_report(suite, table, tmp_path / name)
        # What is read from the CSV is what was in memory.
        table = read_table(suite, tmp_path / "out")
        files = sorted((tmp_path / name).iterdir())
        contents.append({path.name: path.read_bytes() for path in files})
    assert contents[0].keys() == contents[1].keys()
    assert len(contents[0]) > 2
    assert contents[0] == contents[1]


@pytest.mark.medium
def test_a_report_shows_infinite_scores_failures_and_what_was_not_run(
    suite: Suite, results: Results, tmp_path: Path
) -> None:
    text = report_of(suite, results, tmp_path / "out")
    assert "| prior | -inf |" in text
    assert "**-1.00**" in text
    assert "42 of 84 cells were not run" in text
    assert "4 cells failed" in text
    assert "ValueError: no" in text


def test_a_mean_with_one_infinity_is_infinite_and_has_no_spread() -> None:
    assert number_text(pd.Series([-1.0, -math.inf]), ".2f") == "-inf"
    assert number_text(pd.Series([1.0, 3.0]), "+.2f") == "+2.00 ± 1.41"
    assert number_text(pd.Series([1.0]), ".2f") == "1.00"


def test_the_paired_test_sees_what_an_unpaired_one_does_not() -> None:
    generator = np.random.default_rng(0)
    difficulty = 5 * generator.normal(size=200)
    best = difficulty + 0.1 * generator.normal(size=200)
    assert worse(best - 0.1, best)
    assert not worse(best, best)
    assert not worse(difficulty + 0.1 * generator.normal(size=200), best)


def test_the_paired_test_is_not_blinded_by_one_observation() -> None:
    generator = np.random.default_rng(0)
    best = generator.normal(size=1000)
    values = best - 0.3 + 0.5 * generator.normal(size=1000)
    assert worse(values, best)
    values[0] = -30_800.0
    assert worse(values, best)
    lost = best.copy()
    lost[0] = -np.inf
    assert worse(lost, best)
    assert not worse(lost, lost)
    assert not worse(best, lost)


@pytest.mark.medium
def test_a_method_with_a_missing_repetition_still_competes(
    suite: Suite, tmp_path: Path
) -> None:
    results = Results(tmp_path / "cells")
    for cell in suite.cells:
        if cell.method in ("prior", "RoPE") and cell.options == '{"dim": 2}':
            if cell.method == "RoPE" and cell.repetition:
                continue
            value = {"prior": -3.0, "RoPE": -1.0}[cell.method]
            noise = np.random.default_rng(cell.repetition).normal(size=50)
            noise -= noise.mean()
            results.write(cell, *result_of(cell, list(value + 0.1 * noise)))
    text = report_of(suite, results, tmp_path / "out")
    assert "**-1.00**" in text
    assert "**-3.00" not in text


def test_a_method_without_labels_can_be_best_at_one_size_only(
    suite: Suite, tmp_path: Path
) -> None:
    results = Results(tmp_path / "cells")
    for cell in suite.cells:
        if cell.repetition or cell.options != '{"dim": 2}':
            continue
        if cell.method in ("prior", "MLP"):
            value = {0: -2.0, 10: -3.0, 50: -1.0}[cell.n_calibration]
            log_probs = [value + 0.1 * i for i in range(-4, 5)]
            results.write(cell, *result_of(cell, log_probs))
    text = report_of(suite, results, tmp_path / "out")
    assert "| prior | **-2.00** | -2.00 |" in text
    assert "| MLP | -3.00 | **-1.00** |" in text


@pytest.mark.medium
def test_losses_are_listed_against_every_method(suite: Suite, tmp_path: Path) -> None:
    results = Results(tmp_path / "cells")
    for cell in suite.cells:
        if cell.repetition == 0 and cell.method in ("RoPE", "MLP"):
            value = {"RoPE": -2.0, "MLP": -1.0}[cell.method]
            log_probs = [value + 0.1 * i for i in range(-4, 5)]
            results.write(cell, *result_of(cell, log_probs))
    text = report_of(suite, results, tmp_path / "out")
    assert "gamma=0.1 tau=1 #0: -2.00; MLP -1.00\n" in text


def test_the_axis_of_the_figures_is_linear_above_the_prior_and_logarithmic_below() -> (
    None
):
    axis = LPPAxis(prior=-4.0, top=2.0)
    values = np.array([-1000.0, -40.0, -4.0, -1.0, 2.0])
    heights = axis.forward(values)
    assert np.allclose(axis.inverse(heights), values)
    assert heights[2:].tolist() == [0.0, 0.5, 1.0]
    assert axis.forward(-4.0 - 6 * 11) == pytest.approx(-2.0)
    assert axis.forward(-4.0 - 6 * 111) == pytest.approx(-3.0)


def test_a_task_with_a_single_method_without_pairs_has_its_line_and_name(
    suite: Suite, tmp_path: Path
) -> None:
    results = Results(tmp_path / "cells")
    cell = next(cell for cell in suite.cells if cell.method == "prior")
    results.write(cell, *result_of(cell, [-3.1, -3.0, -2.9]))
    rows = write_table(suite, results, tmp_path / "out").finished
    figure = curves("n_calibration", rows)
    (line,) = figure.axes[0].lines
    assert list(line.get_ydata()) == pytest.approx([-3.0, -3.0])
    assert [text.get_text() for text in figure.legends[0].texts] == ["prior"]


@pytest.mark.medium
def test_a_report_without_arrays_marks_nothing(
    suite: Suite, results: Results, tmp_path: Path
) -> None:
    table = write_table(suite, results, tmp_path / "out")
    bare = Table(table.rows, {cell: {} for cell in table.rows.index})
    text = write_report(suite, bare, tmp_path / "bare").read_text()
    assert "**-1.00**" not in text
    assert "-1.00" in text


# Presets ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", list_tasks())
def test_every_preset_builds_an_estimator_for_every_task(name: str) -> None:
    task = get_task(name)
    theta, x = task.get_prior().sample((8,)), torch.randn(8, *task.x_shape)
    for preset, settings_of in PRESETS.items():
        if preset == "paper" and task.paper_settings is None:
            with pytest.raises(ValueError, match="not in the paper"):
                settings_of(task)
            continue
        estimator = settings_of(task).builder(task)(theta, x)
        assert estimator.log_prob(theta[None], condition=x).shape == (1, 8)


def test_the_papers_flow_has_the_papers_layers() -> None:
    task = get_task("pendulum")
    settings = PRESETS["paper"](task)
    theta, x = task.get_prior().sample((8,)), torch.randn(8, *task.x_shape)
    estimator = settings.builder(task)(theta, x)
    widths = [
        tuple(weight.shape[-2:])
        for name, weight in estimator.net.named_parameters()
        if name.endswith("weight")
    ]
    # Conditioner and integrand: three hidden layers of 100 each.
    assert sum(shape == (100, 100) for shape in widths) == 4
