"""The benchmark's cells, presets and figures, without training anything."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from benchmarks.cells import Cell, Suite, data_in_words, list_suites, load_suite
from benchmarks.figures import LPPAxis, curves, draw_all
from benchmarks.methods import METHODS
from benchmarks.presets import PRESETS
from benchmarks.published import finished
from benchmarks.store import Results
from sbi_rope.tasks import get_task, list_tasks
from tests.results import SUITE, fill, result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]


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
    methods = [cell.method for cell in suite.cells]
    counts = {method: methods.count(method) for method in dict.fromkeys(methods)}
    # Two repetitions and two dimensions; sizes and couplings only where they matter.
    assert counts == {"prior": 4, "MLP": 8, "OT-only": 24, "RoPE": 48}
    # Repetition, dimension, size, cost scale: gamma and tau share a training.
    groups = {cell.group for cell in suite.cells if cell.method == "RoPE"}
    assert len(groups) == 2 * 2 * 2 * 2
    chosen = suite.select(methods=["prior", "MLP"])
    assert {cell.method for cell in chosen} == {"prior", "MLP"}


def test_the_arrays_of_committed_cells_keep_their_names() -> None:
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
    path = tmp_path / "wrong.toml"
    path.write_text(SUITE.replace("taus", "tau"))
    with pytest.raises(SystemExit, match=r"Unknown key.*'tau'"):
        load_suite(str(path))
    for name in ("magic", "stack of a batch"):
        path.write_text(SUITE.replace("OT-only", name))
        with pytest.raises(SystemExit, match=f"No method '{name}'; there are"):
            load_suite(str(path))


def test_titles_and_messages_state_options_in_words() -> None:
    options = '{"label_noise": 0.1, "stand_in": true}'
    assert data_in_words("sir", "", options) == ["sir", "label noise 0.1", "stand in"]
    cell = Cell(task="sir", variant="prior_shift", options=options, method="prior")
    assert str(cell) == "sir prior_shift label noise 0.1 stand in prior #0"


def test_ci_expects_as_many_finished_cells_as_the_smoke_suite_has() -> None:
    cells = load_suite("smoke").cells
    assert f"\nexpected={len(cells)} " in (ROOT / ".ci" / "run").read_text()
    everywhere = {
        name for name, entry in METHODS.items() if not (entry.extra or entry.past)
    }
    assert {cell.method for cell in cells} == everywhere


# Figures ----------------------------------------------------------------------------


def test_no_two_methods_are_drawn_alike() -> None:
    styles = [entry.style for entry in METHODS.values()]
    assert len(set(styles)) == len(styles)


@pytest.mark.slow
def test_the_same_results_give_the_same_pictures(suite: Suite, tmp_path: Path) -> None:
    results = Results(tmp_path / "tiny")
    fill(results, suite)
    paths = draw_all(suite, results)
    names = [path.name for path in paths]
    corners = [f"corner-linear_gaussian-dim_{dim}.png" for dim in (2, 3)]
    assert names == ["n_calibration.png", "calibration.png", *corners]
    before = [path.read_bytes() for path in paths]
    results.tidy(suite.cells)
    assert draw_all(suite, results) == paths
    assert [path.read_bytes() for path in paths] == before


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
    results = Results(tmp_path / "tiny")
    cell = next(cell for cell in suite.cells if cell.method == "prior")
    results.add([result_of(cell, -3.0)])
    figure = curves("n_calibration", finished(results.rows))
    (line,) = figure.axes[0].lines
    assert list(line.get_ydata()) == pytest.approx([-3.0, -3.0])
    assert [text.get_text() for text in figure.legends[0].texts] == ["prior"]


@pytest.mark.slow
def test_the_legend_of_the_suite_with_the_most_methods_is_not_cut_off() -> None:
    rows = finished(Results(ROOT / "benchmarks" / "results" / "main").rows)
    figure = curves("n_calibration", rows)
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    assert len(legend.texts) > 25
    drawn, whole = legend.get_window_extent(), figure.bbox
    assert drawn.ymin >= whole.ymin
    assert drawn.ymax <= whole.ymax
    assert drawn.xmax <= whole.xmax


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
