"""The benchmark's runner on real cells, interrupted, in parallel, and with failures."""

import csv
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.__main__ import main
from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell, load_suite
from benchmarks.methods import METHODS
from benchmarks.runner import Workplace, run_cells
from benchmarks.scoring import Score, scores
from benchmarks.store import Results
from sbi_rope import SinkhornCoupler
from sbi_rope.baselines import OTOnly
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
SUITE = """
title = "Tiny"
question = "Nothing."
preset = "smoke"
repetitions = 1

[[cells]]
tasks = ["pendulum"]
methods = ["prior", "NPE", "tuning-only", "OT-only", "RoPE"]
n_calibration = [10]
gammas = { simulated = [0.1] }
taus = [1.0, 0.9]
"""
# What may differ between two runs of the same cell.
CHANGING = ("seconds_", "peak_memory", "finished_at", "git_commit", "suite")


@pytest.fixture(scope="module")
def suite_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("suite") / "tiny.toml"
    path.write_text(SUITE)
    return path


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "tiny" / "results.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if not k.startswith(CHANGING)}
            for row in csv.DictReader(file)
        ]


@pytest.fixture(scope="module")
def uninterrupted(
    suite_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> list[dict[str, str]]:
    folder = tmp_path_factory.mktemp("uninterrupted")
    main(["run", str(suite_file), "--out", str(folder)])
    return rows_of(folder)


@pytest.mark.slow
def test_a_run_in_parts_gives_the_same_table(
    suite_file: Path, uninterrupted: list[dict[str, str]], tmp_path: Path
) -> None:
    assert len(uninterrupted) == 7
    assert {row["status"] for row in uninterrupted} == {"finished"}
    command = ["run", str(suite_file), "--out", str(tmp_path)]
    main([*command, "--method", "RoPE", "prior"])
    main(command)
    assert rows_of(tmp_path) == uninterrupted


def test_status_counts_what_is_finished_and_what_is_not_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = load_suite("smoke")
    Results(tmp_path / "smoke").add(
        [result_of(suite.cells[0], -1.0), result_of(suite.cells[1], "failed")]
    )
    assert main(["status", "--out", str(tmp_path)]) == 0
    total = len(suite.cells)
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["smoke", str(total), "1", "1", str(total - 2)] in printed


@pytest.mark.medium
def test_stored_people_are_shared_out_without_overlap(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="smoke", method="SBI")
    place = Workplace(folder=tmp_path)
    case = place.case(cell)
    assert case.held_out is not None
    held_out = set(case.held_out[0][:, 0].tolist())
    for pairs in (case.simulations, case.stored):
        assert held_out.isdisjoint(pairs[0][:, 0].tolist())
    cells = [replace(cell, method=method) for method in ("prior", "SBI")]
    assert run_cells(cells, Results(tmp_path / "tiny"), place)["finished"] == 2


@pytest.mark.medium
def test_the_test_set_is_as_large_as_what_is_recorded(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="standard", method="prior")
    case = Case.of(cell, Sources(), tmp_path, "cpu")
    recorded = case.task.num_recorded("test")
    assert recorded is not None
    assert recorded < case.settings.n_test
    assert len(case.test_set[0]) == recorded


def test_people_of_the_simulator_are_the_real_ones_where_it_is_right(
    tmp_path: Path,
) -> None:
    import sbi_rope.tasks.hemodynamics.data as package

    sources = Sources(hemodynamics=Path(next(iter(package.__path__))))
    cell = Cell(task="hemodynamics", preset="smoke", method="stack", n_calibration=5)
    right = replace(cell, variant="well_specified")
    for one in (cell, right):
        case = Case.of(one, sources, tmp_path, "cpu")
        simulated = {tuple(theta) for theta in case.stored[0].tolist()}
        # In neither is anyone both simulated and observed.
        for theta, _ in (case.calibration, case.test_set):
            assert simulated.isdisjoint(map(tuple, theta.tolist()))


@pytest.mark.medium
def test_what_is_finished_is_not_computed_again(
    suite_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", str(suite_file), "--out", str(tmp_path), "--method", "prior"]
    path = tmp_path / "tiny" / "results.csv"
    main(command)
    before = path.read_bytes()
    capsys.readouterr()
    main(command)
    assert "1 kept, 0 finished, 0 failed" in capsys.readouterr().out
    assert path.read_bytes() == before
    main([*command, "--again"])
    assert "0 kept, 1 finished, 0 failed" in capsys.readouterr().out


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_table(
    suite_file: Path, uninterrupted: list[dict[str, str]], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "benchmarks", "run", str(suite_file)]
    command += ["--out", str(tmp_path), "--jobs", "2"]
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    results = Results(tmp_path / "tiny")
    while len(results.rows) < 2:
        assert process.poll() is None, (tmp_path / "output").read_text()
        time.sleep(0.05)
    process.kill()
    process.wait()
    kept = len(results.rows)
    assert 2 <= kept < len(uninterrupted)
    again = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert f"{kept} kept, {len(uninterrupted) - kept} finished" in again.stdout
    assert rows_of(tmp_path) == uninterrupted


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_two_workers_give_the_same_table(
    backend: str,
    suite_file: Path,
    uninterrupted: list[dict[str, str]],
    tmp_path: Path,
) -> None:
    if backend == "dask":
        pytest.importorskip("distributed")
    command = [sys.executable, "-m", "benchmarks", "run", str(suite_file)]
    command += ["--out", str(tmp_path), "--jobs", "2", "--backend", backend]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert rows_of(tmp_path) == uninterrupted


@pytest.mark.medium
def test_a_failing_method_does_not_stop_the_others_and_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "failing.toml"
    # HVAE needs a differentiable simulator, which this task has not.
    suite.write_text(
        'title = "Failing"\nquestion = "Does it fail?"\npreset = "smoke"\n'
        'repetitions = 1\n[[cells]]\ntasks = ["sir"]\nmethods = ["HVAE", "prior"]\n'
        "n_calibration = [10]\n"
    )
    command = ["run", str(suite), "--out", str(tmp_path / "out")]
    for more, counts in (
        ([], "0 kept, 1 finished, 1 failed"),
        ([], "2 kept, 0 finished, 0 failed"),
        (["--retry"], "1 kept, 0 finished, 1 failed"),
    ):
        assert main([*command, *more]) == 1
        printed = capsys.readouterr().out
        assert counts in printed
        assert "failed: sir HVAE n_c=10 #0: " in printed
    assert main([*command, "--method", "prior"]) == 0


def test_methods_see_the_same_data_and_repetitions_do_not(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="NPE", n_calibration=10)
    cases = [
        Case.of(other, Sources(), tmp_path, "cpu")
        for other in (
            cell,
            replace(cell, method="RoPE", gamma=0.1, tau=1.0),
            replace(cell, repetition=1),
            replace(cell, variant="prior_shift"),
        )
    ]
    first, same, other, shifted = cases
    for name in ("simulations", "calibration", "test_set"):
        ours, theirs, others = (
            torch.cat([part.flatten() for part in getattr(case, name)])
            for case in (first, same, other)
        )
        assert torch.equal(ours, theirs)
        assert not torch.equal(ours, others)
    # A variant of the real process has the same simulations, and shares the NPE.
    assert torch.equal(first.simulations[1], shifted.simulations[1])
    assert not torch.equal(first.test_set[1], shifted.test_set[1])
    assert first.npe is not None
    assert shifted.npe is not None
    assert len(list(tmp_path.glob("npe-*"))) == 1


def smoke_case(task: str, folder: Path) -> Case:
    cell = Cell(task=task, preset="smoke", method="NPE", n_calibration=10)
    return Case.of(cell, Sources(), folder, "cpu")


def test_entries_say_which_methods_see_calibration_pairs_and_observations(
    tmp_path: Path,
) -> None:
    case = smoke_case("linear_gaussian", tmp_path)
    for name, entry in METHODS.items():
        if entry.build and case.task.name in (entry.tasks or (case.task.name,)):
            sees = entry.build(case).sees
            assert ("calibration" in sees) == entry.pairs, name
            assert ("observations" in sees) == entry.observations, name


def test_the_row_of_ot_only_is_that_of_the_method_of_its_name(tmp_path: Path) -> None:
    case = smoke_case("linear_gaussian", tmp_path)
    cell = replace(
        case.cell, method="OT-only", gamma=0.1, tau=1.0, cost_scale="simulated"
    )
    (score,) = scores(replace(case, cell=cell), [cell])
    assert isinstance(score, Score)
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
    assert torch.equal(ours[0], score.evaluation.log_prob)


@pytest.mark.slow
def test_what_is_fine_tuned_is_a_discrepancy_of_x_itself_where_it_is_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.methods.NUM_HOLDOUTS", 2)
    build = METHODS["discrepancy, fine-tuned"].build
    assert build is not None
    method: Any = build(smoke_case("pendulum", tmp_path / "long"))
    assert method.space == "embedding"
    case = smoke_case("linear_gaussian", tmp_path / "short")
    method = build(case)
    assert method.space == "input"
    method.append_calibration(*case.calibration)
    method.train(seed=0, show_progress_bars=False)
    assert method.build_posterior().posterior_estimator.num_members == 2
    # The corrected NPE is the start: the discrepancy was fitted, too.
    assert method.discrepancy.num_independent == 10
