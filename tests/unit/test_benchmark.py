"""The benchmark's cells, suites, presets, results and figures; nothing is trained."""

import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.cells import Cell
from benchmarks.figures import LPPAxis, draw_suite
from benchmarks.methods import METHODS
from benchmarks.presets import PRESETS
from benchmarks.store import Results
from benchmarks.suites import Suite, list_suites, load_suite
from sbi_rope.tasks import get_task, list_tasks
from sbi_rope.utils.files import write_atomically
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "benchmarks" / "results"
SUITE = """
preset = "smoke"
repetitions = 2

[[cells]]
tasks = ["linear_gaussian"]
methods = ["prior", "MLP", "OT-only", "RoPE"]
n_calibration = [10, 50]
gammas = { simulated = [0.1, 0.2], none = [0.5] }
taus = [1.0, 0.9]
options = { dim = [2, 3] }
"""
ROPE = {"method": "RoPE", "gamma": 0.1, "tau": 1.0, "cost_scale": "simulated"}
CELLS = [
    Cell(task="cs", method="prior"),
    Cell(task="cs", n_calibration=10, **ROPE),
    Cell(task="cs", method="MLP", n_calibration=50, options='{"label_noise": 0.1}'),
]


@pytest.fixture
def suite(tmp_path: Path) -> Suite:
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE)
    return load_suite(str(path))


# Cells and suites -------------------------------------------------------------------


def test_a_suite_lists_every_combination_once_and_under_a_name_of_its_own(
    suite: Suite,
) -> None:
    assert len({cell.key for cell in suite.cells}) == len(suite.cells)
    methods = pd.Series([cell.method for cell in suite.cells]).value_counts()
    # Two repetitions and two dimensions; sizes and couplings only where they matter.
    assert methods.to_dict() == {"prior": 4, "MLP": 8, "OT-only": 24, "RoPE": 48}
    # Repetition, dimension, size, cost scale: gamma and tau share a training.
    trainings = {cell.training for cell in suite.cells if cell.method == "RoPE"}
    assert len(trainings) == 2 * 2 * 2 * 2
    assert len({cell.data for cell in suite.cells}) == 2 * 2


def test_cells_are_selected_by_their_fields(suite: Suite) -> None:
    chosen = suite.select(method=["prior", "MLP"], n_calibration=[50], repetition=None)
    assert {(c.method, c.n_calibration) for c in chosen} == {("prior", 0), ("MLP", 50)}
    with pytest.raises(SystemExit, match=r"expected task among .*linear_gaussian"):
        suite.select(task=["sir"])


def test_the_suites_that_come_along_can_be_read() -> None:
    for suite in map(load_suite, list_suites()):
        assert {cell.preset for cell in suite.cells} <= {*PRESETS}
        assert {cell.task for cell in suite.cells} <= {*list_tasks()}


def test_unknown_names_are_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"No suite 'nonsense'; there are .*smoke"):
        load_suite("nonsense")
    path = tmp_path / "wrong.toml"
    for wrong, message in (("taus", "key among .*'taus'"), ("MLP", "method among")):
        path.write_text(SUITE.replace(wrong, "unheard-of"))
        with pytest.raises(SystemExit, match=f"{message}.*got .'unheard-of'"):
            load_suite(str(path))


def test_the_smoke_suite_has_every_method_and_as_many_cells_as_ci_expects() -> None:
    cells = load_suite("smoke").cells
    assert f"\nexpected={len(cells)} " in (ROOT / ".ci" / "run").read_text()
    slow = {"RNPE", "HVAE"}
    assert {cell.method for cell in cells} == {*METHODS} - slow - {"stack, given prior"}
    # No two are drawn alike.
    assert len({entry.style for entry in METHODS.values()}) == len(METHODS)


# Results ----------------------------------------------------------------------------


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def interrupted() -> None:
        with write_atomically(path) as temporary:
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_results_survive_being_written_and_read(tmp_path: Path) -> None:
    results = Results(tmp_path / "tiny")
    assert len(results.rows) == 0
    results.add([result_of(CELLS[1], 1 / 3), result_of(CELLS[2], "failed")])
    results.add([result_of(CELLS[0], -math.inf)])
    before = results.path.read_text().splitlines()
    results.sort(CELLS)
    after = results.path.read_text().splitlines()
    rows = results.rows
    assert [*rows.index] == CELLS
    assert rows["lpp_z"].iloc[:2].tolist() == [-math.inf, 1 / 3]
    assert rows["error"].tolist() == ["", "", "ValueError: no"]
    # To the letter, in another order.
    assert sorted(before) == sorted(after)
    assert before != after
    with np.load(results.folder / "arrays" / f"{CELLS[1].key}.npz") as arrays:
        assert arrays["log_probs"].tolist() == [1 / 3] * 3
    # A later result of a cell takes the place of the earlier one.
    results.add([result_of(CELLS[2], -1.0)])
    assert results.rows["lpp_z"].tolist() == [-math.inf, 1 / 3, -1.0]


def test_rows_of_another_suite_are_taken_over(tmp_path: Path) -> None:
    first, second = Results(tmp_path / "first"), Results(tmp_path / "second")
    first.add(result_of(cell, -1.0) for cell in CELLS)
    second.add([result_of(CELLS[1], -2.0)])
    second.take_over(CELLS[:2])
    assert second.rows["lpp_z"].to_dict() == {CELLS[1]: -2.0, CELLS[0]: -1.0}
    assert {*second.rows["suite"]} == {"second"}


def test_committed_rows_stay_as_they_are_when_a_run_goes_on_from_them(
    tmp_path: Path,
) -> None:
    shutil.copytree(COMMITTED / "failures", tmp_path / "failures")
    results = Results(tmp_path / "failures")
    before = results.rows
    assert (before["git_commit"][before["status"] == "finished"] != "").all()
    results.add([result_of(CELLS[0], -1.0)])
    after = results.rows
    pd.testing.assert_frame_equal(after.iloc[:-1][before.columns], before)
    assert after["lpp_z"][CELLS[0]] == -1.0


# Figures ----------------------------------------------------------------------------


@pytest.mark.medium
def test_a_suite_is_drawn_with_failures_and_what_is_not_finite(
    suite: Suite, tmp_path: Path
) -> None:
    scores = {"prior": -math.inf, "MLP": "failed", "OT-only": -2.0, "RoPE": -1.0}
    results = Results(tmp_path / "tiny")
    draw_suite(suite, results.rows, results.folder)  # without a result there is nothing
    results.add(result_of(cell, scores[cell.method]) for cell in suite.cells)
    draw_suite(suite, results.rows, results.folder)
    assert [path.name for path in results.folder.glob("*.png")] == ["n_calibration.png"]


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
