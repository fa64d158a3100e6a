"""The benchmark's runner on real cells, interrupted, in parallel, and with failures."""

import csv
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import runner
from benchmarks.__main__ import main
from benchmarks.cases import Case, Workplace
from benchmarks.cells import Cell
from benchmarks.methods import METHODS, STACKS
from benchmarks.runner import code_version, run_cells
from benchmarks.scoring import score
from benchmarks.store import Results
from benchmarks.suites import load_suite
from sbi_rope import SinkhornCoupler
from sbi_rope.baselines import OTOnly
from tests.results import result_of

pytestmark = pytest.mark.usefixtures("rough_pictures")

ROOT = Path(__file__).parents[2]
SUITE = """
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
CHANGING = ("seconds_", "finished_at", "git_commit", "suite")


@pytest.fixture
def suite_file(tmp_path: Path) -> str:
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE)
    return str(path)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "tiny" / "results.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if not k.startswith(CHANGING)}
            for row in csv.DictReader(file)
        ]


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
    suite_file: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command = ["run", suite_file, "--out", str(tmp_path), "--method"]
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
    # Of changed code, too.
    monkeypatch.setattr(runner, "code_version", lambda: "bbbbbbb+")
    for _ in range(2):
        main([*command, "prior", "--again"])
        assert "0 kept, 1 finished" in capsys.readouterr().out


def test_results_and_pages_make_no_other_version_of_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*args: str) -> None:
        user = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        subprocess.run(("git", *user, *args), cwd=tmp_path, check=True)

    assert all((ROOT / path).exists() for path in runner.CODE)
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    git("init", "-q")
    versions = []
    for name in ("sbi_rope/a.py", "benchmarks/results.csv", "benchmarks/cases.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1")
        git("add", ".")
        git("commit", "-q", "-m", "-")
        versions.append(code_version())
    assert versions[0] == versions[1] != versions[2]
    (tmp_path / "benchmarks" / "results.csv").write_text("2")
    assert code_version() == versions[2]
    (tmp_path / "sbi_rope" / "a.py").write_text("2")
    assert code_version() == f"{versions[2]}+"


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_table_of_one_that_was_not(
    suite_file: str, tmp_path: Path
) -> None:
    assert main(["run", suite_file, "--out", str(tmp_path / "whole")]) == 0
    whole = rows_of(tmp_path / "whole")
    assert len(whole) == 7
    command = [sys.executable, "-m", "benchmarks", "run", suite_file, "--jobs", "2"]
    command += ["--out", str(tmp_path)]
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    results = Results(tmp_path / "tiny")
    while len(results.rows) < 2:
        assert process.poll() is None, (tmp_path / "output").read_text()
        time.sleep(0.05)
    process.kill()
    process.wait()
    kept = len(results.rows)
    assert 2 <= kept < len(whole)
    again = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert f"{kept} kept, {len(whole) - kept} finished" in again.stdout
    assert rows_of(tmp_path) == whole


@pytest.mark.medium
def test_a_failing_method_does_not_stop_the_others_and_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "failing.toml"
    # HVAE needs a differentiable simulator, which this task has not.
    suite.write_text(
        'preset = "smoke"\nrepetitions = 1\n[[cells]]\ntasks = ["sir"]\n'
        'methods = ["HVAE", "prior"]\nn_calibration = [10]\n'
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
    rows = Results(tmp_path / "out" / "failing").rows
    assert {*rows["git_commit"]} == {code_version()}
    assert main([*command, "--method", "prior"]) == 0


def test_methods_see_the_same_data_and_repetitions_do_not(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="NPE", n_calibration=10)
    first, same, other, shifted = (
        Case(one, Workplace(tmp_path))
        for one in (
            cell,
            replace(cell, method="RoPE", gamma=0.1, tau=1.0),
            replace(cell, repetition=1),
            replace(cell, variant="prior_shift"),
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
    assert torch.equal(first.simulations[1], shifted.simulations[1])
    assert not torch.equal(first.test_set[1], shifted.test_set[1])
    theta, x = first.test_set
    ours, theirs = (
        case.npe.log_prob_batched(theta[None], x) for case in (first, shifted)
    )
    assert torch.equal(ours, theirs)
    assert len(list((tmp_path / "cache").glob("npe-*.pt"))) == 1


class Thief:
    """Runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "code was run")


def test_reading_what_cells_share_runs_no_code(tmp_path: Path) -> None:
    assert smoke_case("linear_gaussian", tmp_path).npe is not None
    for path in (tmp_path / "cache").glob("*.pt"):
        kept = path.read_bytes()
        torch.save(Thief(tmp_path / "proof"), path)
        with pytest.raises(Exception, match=r"could run anything|Weights only load"):
            _ = smoke_case("linear_gaussian", tmp_path).npe
        path.write_bytes(kept)
    assert not (tmp_path / "proof").exists()


def smoke_case(task: str, folder: Path, **fields: Any) -> Case:
    fields = {"method": "NPE", "n_calibration": 10} | fields
    return Case(Cell(task=task, preset="smoke", **fields), Workplace(folder))


def test_entries_say_which_methods_see_calibration_pairs_and_observations(
    tmp_path: Path,
) -> None:
    case = smoke_case("pendulum", tmp_path)
    for name, entry in METHODS.items():
        if entry.couples or name in STACKS:
            assert entry.build is None
            continue
        assert entry.build is not None
        sees = entry.build(case).sees
        assert ("calibration" in sees) == entry.pairs, name
        assert ("observations" in sees) == entry.observations, name


def test_the_row_of_ot_only_is_that_of_the_method_of_its_name(tmp_path: Path) -> None:
    coupling = {"gamma": 0.1, "tau": 1.0, "cost_scale": "simulated"}
    case = smoke_case("linear_gaussian", tmp_path, method="OT-only", **coupling)
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
    assert method.discrepancy.probability_of_none < 1
