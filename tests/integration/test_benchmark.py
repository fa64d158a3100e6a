"""The benchmark's cells, results and figures, and its runner on real cells."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks import runner
from benchmarks.__main__ import main
from benchmarks.cases import Case, Workplace
from benchmarks.cells import Cell
from benchmarks.figures import draw_suite
from benchmarks.methods import METHODS, STACKS
from benchmarks.presets import PRESETS
from benchmarks.runner import run_cells
from benchmarks.scoring import score
from benchmarks.store import Results
from benchmarks.suites import Suite, list_suites, load_suite
from sbi_rope import SinkhornCoupler
from sbi_rope.baselines import OTOnly
from sbi_rope.tasks import get_task, list_tasks
from sbi_rope.utils.files import write_atomically
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
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
SMALL = """
preset = "smoke"
repetitions = 1

[[cells]]
tasks = ["sir"]
methods = ["prior", "NPE", "HVAE"]
n_calibration = [10]
"""
COUPLING: dict[str, Any] = {"gamma": 0.1, "tau": 1.0, "cost_scale": "simulated"}
CELLS = [
    Cell(task="cs", method="prior"),
    Cell(task="cs", method="RoPE", n_calibration=10, **COUPLING),
    Cell(task="cs", method="MLP", n_calibration=50, options='{"label_noise": 0.1}'),
]


def written(suite: str, folder: Path) -> str:
    path = folder / "tiny.toml"
    path.write_text(suite)
    return str(path)


@pytest.fixture
def suite(tmp_path: Path) -> Suite:
    return load_suite(written(SUITE, tmp_path))


def smoke_case(task: str, folder: Path, **fields: Any) -> Case:
    fields = {"method": "NPE", "n_calibration": 10} | fields
    return Case(Cell(task=task, preset="smoke", **fields), Workplace(folder))


# Cells and suites -------------------------------------------------------------------


def test_a_suite_lists_every_combination_under_a_name_of_its_own(suite: Suite) -> None:
    assert len({cell.key for cell in suite.cells}) == len(suite.cells)
    methods = pd.Series([cell.method for cell in suite.cells]).value_counts()
    # Two repetitions and two dimensions; sizes and couplings only where they matter.
    assert methods.to_dict() == {"prior": 4, "MLP": 8, "OT-only": 24, "RoPE": 48}
    # Repetition, dimension, size, cost scale: gamma and tau share a training.
    trainings = {cell.training for cell in suite.cells if cell.method == "RoPE"}
    assert len(trainings) == 2 * 2 * 2 * 2
    assert len({cell.data for cell in suite.cells}) == 2 * 2


def test_suites_and_cells_are_selected_by_name(suite: Suite) -> None:
    chosen = suite.select(method=["prior", "MLP"], n_calibration=[50], repetition=None)
    assert {(c.method, c.n_calibration) for c in chosen} == {("prior", 0), ("MLP", 50)}
    with pytest.raises(SystemExit, match=r"expected task among .*linear_gaussian"):
        suite.select(task=["sir"])
    with pytest.raises(SystemExit, match=r"No suite 'nonsense'; there are .*smoke"):
        load_suite("nonsense")


def test_the_suites_that_come_along_can_be_read_and_smoke_has_every_method() -> None:
    for suite in map(load_suite, list_suites()):
        assert {cell.preset for cell in suite.cells} <= {*PRESETS}
        assert {cell.task for cell in suite.cells} <= {*list_tasks()}
    cells = load_suite("smoke").cells
    # As many as continuous integration expects.
    assert f"\nexpected={len(cells)} " in (ROOT / ".ci" / "run").read_text()
    slow = {"RNPE", "HVAE"}
    assert {cell.method for cell in cells} == {*METHODS} - slow - {"stack, given prior"}
    # No two are drawn alike.
    assert len({entry.style for entry in METHODS.values()}) == len(METHODS)


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


# Runs -------------------------------------------------------------------------------


@pytest.mark.medium
def test_stored_people_are_shared_out_without_overlap(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="smoke", method="SBI")
    place = Workplace(tmp_path)
    case = Case(cell, place)
    held_out = set(case.held_out[0][:, 0].tolist())
    for pairs in (case.simulations, case.stored):
        assert held_out.isdisjoint(pairs[0][:, 0].tolist())
    cells = [replace(cell, method=method) for method in ("prior", "SBI")]
    assert run_cells(cells, Results(tmp_path / "tiny"), place)["finished"] == 2


def test_people_of_the_simulator_are_the_real_ones_where_it_is_right(
    tmp_path: Path,
) -> None:
    import sbi_rope.tasks.hemodynamics.data as package

    people = Path(next(iter(package.__path__)))
    cell = Cell(task="hemodynamics", preset="smoke", method="stack", n_calibration=5)
    for one in (cell, replace(cell, variant="well_specified")):
        case = Case(one, Workplace(tmp_path, hemodynamics=people))
        simulated = {tuple(theta) for theta in case.stored[0].tolist()}
        # In neither is anyone both simulated and observed.
        for theta, _ in (case.calibration, case.test_set):
            assert simulated.isdisjoint(map(tuple, theta.tolist()))


@pytest.mark.medium
def test_only_what_another_version_has_made_is_computed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all((ROOT / path).exists() for path in runner.CODE)
    command = ["run", written(SMALL, tmp_path), "--out", str(tmp_path), "--method"]
    path = tmp_path / "tiny" / "results.csv"
    monkeypatch.setattr(runner, "code_version", lambda: "aaaaaaa")
    main([*command, "prior"])
    before = path.read_bytes()
    capsys.readouterr()
    monkeypatch.setattr(runner, "code_version", lambda: "bbbbbbb")
    main([*command, "prior"])
    assert "1 kept, 0 finished, 0 failed" in capsys.readouterr().out
    assert path.read_bytes() == before
    for count in ("0 kept, 2 finished", "2 kept, 0 finished"):
        main([*command, "prior", "NPE", "--again"])
        assert count in capsys.readouterr().out
    assert {*Results(path.parent).rows["git_commit"]} == {"bbbbbbb"}


@pytest.mark.medium
def test_a_failing_method_does_not_stop_the_others_and_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", written(SMALL, tmp_path), "--out", str(tmp_path), "--method"]
    # HVAE needs a differentiable simulator, which this task has not.
    for more, counts in (
        ([], "0 kept, 1 finished, 1 failed"),
        ([], "2 kept, 0 finished, 0 failed"),
        (["--retry"], "1 kept, 0 finished, 1 failed"),
    ):
        assert main([*command, "HVAE", "prior", *more]) == 1
        printed = capsys.readouterr().out
        assert counts in printed
        assert "failed: sir HVAE n_c=10 #0: " in printed
    assert main([*command, "prior"]) == 0


def test_methods_see_the_same_data_and_repetitions_do_not(tmp_path: Path) -> None:
    first, same, other, shifted = (
        smoke_case("linear_gaussian", tmp_path, **fields)
        for fields in (
            {},
            {"method": "RoPE", **COUPLING},
            {"repetition": 1},
            {"variant": "prior_shift"},
        )
    )
    for name in ("simulations", "calibration", "test_set"):
        ours, theirs, others = (
            torch.cat([part.flatten() for part in getattr(case, name)])
            for case in (first, same, other)
        )
        assert torch.equal(ours, theirs)
        assert not torch.equal(ours, others)
    # A variant of the real process has the same simulations, and shares the NPE.
    assert not torch.equal(first.test_set[1], shifted.test_set[1])
    _ = first.npe, shifted.npe
    assert len(list((tmp_path / "cache").glob("npe-*.pt"))) == 1


def test_entries_say_which_methods_see_calibration_pairs_and_observations(
    tmp_path: Path,
) -> None:
    case = smoke_case("pendulum", tmp_path)
    for name, entry in METHODS.items():
        if entry.build is None:
            assert entry.couples or name in STACKS
            continue
        sees = entry.build(case).sees
        assert ("calibration" in sees) == entry.pairs, name
        assert ("observations" in sees) == entry.observations, name


def test_the_row_of_ot_only_is_that_of_the_method_of_its_name(tmp_path: Path) -> None:
    case = smoke_case("linear_gaussian", tmp_path, method="OT-only", **COUPLING)
    (result,) = score(case, [case.cell])
    method = OTOnly.from_posterior(
        case.npe,
        simulator=case.simulator,
        coupler=SinkhornCoupler(gamma=0.1, cost_scale="simulated"),
    )
    method.append_observations(case.test_set[1])
    method.train(seed=case.seed, show_progress_bars=False)
    ours = method.build_posterior().log_prob_batched(
        case.test_set[0][None], case.test_set[1]
    )
    assert np.array_equal(ours[0].numpy(), result.arrays["log_probs"])
