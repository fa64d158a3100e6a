"""The benchmark's runner on real cells, interrupted, in parallel, and with failures."""

import csv
import json
import os
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
from benchmarks.runner import run_cells
from benchmarks.scoring import Score, scores
from benchmarks.store import SAME_PRESETS, Cache, Workplace
from sbi_rope import SinkhornCoupler
from sbi_rope.baselines import OTOnly
from sbi_rope.errors import RoPEWarning

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
def test_a_run_in_parts_gives_the_same_table_also_where_a_cell_was_damaged(
    suite_file: Path, uninterrupted: list[dict[str, str]], tmp_path: Path
) -> None:
    assert len(uninterrupted) == 7
    assert {row["status"] for row in uninterrupted} == {"finished"}
    command = ["run", str(suite_file), "--out", str(tmp_path)]
    main([*command, "--method", "RoPE", "prior"])
    rope = [c for c in load_suite(str(suite_file)).cells if c.method == "RoPE"]
    # The last of a sweep, as if killed while writing in place.
    last = min(rope, key=lambda cell: cell.tau or 0)
    (tmp_path / "cells" / f"{last.key}.json").write_text("{")
    with pytest.warns(RoPEWarning, match="is damaged and is computed again"):
        main(command)
    assert rows_of(tmp_path) == uninterrupted


@pytest.mark.medium
def test_a_folder_belongs_to_the_data_it_was_first_used_with(
    suite_file: Path, tmp_path: Path
) -> None:
    command = ["run", str(suite_file), "--out", str(tmp_path), "--method", "prior"]
    main(command)
    with pytest.raises(SystemExit, match="another root"):
        main([*command, "--again", "--root", str(tmp_path)])
    place = tmp_path / "place.json"
    good = place.read_text()
    for number, content in enumerate(("", "{", "[1]"), 1):
        place.write_text(content)
        with pytest.warns(RoPEWarning) as warned:
            main(command)
        texts = " ".join(str(one.message) for one in warned)
        assert "place.json is damaged and is now" in texts
        assert "made with is not known" in texts
        assert (tmp_path / f"place.json.damaged-{number}").read_text() == content
        assert place.read_text() == good
    # Settings that are worded differently are the same; others are not.
    for checksum, known in ((SAME_PRESETS[0], True), ("0" * 64, False)):
        place.write_text(json.dumps(json.loads(good) | {"presets": checksum}))
        if known:
            assert main(command) == 0
            continue
        with pytest.raises(SystemExit, match="another presets"):
            main(command)


@pytest.mark.medium
def test_two_runs_do_not_share_a_folder(
    suite_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.store.PATIENCE", 0.1)
    command = ["run", str(suite_file), "--out", str(tmp_path), "--method", "prior"]
    with (
        Workplace(folder=tmp_path, sources=Sources()).claimed(),
        pytest.raises(SystemExit, match=r"another process works in .*another --out"),
    ):
        main(command)
    assert not (tmp_path / "cells").exists()
    # Neither the lock of a run that ended nor its file is in the way.
    assert main(command) == 0


def test_a_folder_that_cannot_be_written_to_is_refused_in_words(
    suite_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").write_text("a file")
    folders = [tmp_path / "out", tmp_path / "out" / "below", tmp_path / "closed"]
    folders[-1].mkdir(mode=0o500)
    if os.access(folders[-1], os.W_OK):  # this user may write to read-only folders
        folders.pop()
    for folder in folders:
        with pytest.raises(SystemExit, match=r"can be written to.*Use another --out"):
            main(["run", str(suite_file), "--out", str(folder)])


def test_an_axis_cannot_lead_out_of_the_folder(
    suite_file: Path, tmp_path: Path
) -> None:
    path = tmp_path / "evil.toml"
    path.write_text(f'x_axis = "../../../evil"\n{SUITE}')
    with pytest.raises(SystemExit, match="Expected x_axis in"):
        main(["run", str(path), "--out", str(tmp_path / "a" / "b" / "out")])
    assert list(tmp_path.iterdir()) == [path]


def test_a_cell_without_a_result_is_no_success(
    suite_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # As if a worker had lost it.
    monkeypatch.setattr("benchmarks.runner.run_group", lambda *_: [])
    command = ["run", str(suite_file), "--out", str(tmp_path), "--method", "prior"]
    assert main(command) == 1
    assert "no result: pendulum prior #0" in capsys.readouterr().out


@pytest.mark.medium
def test_stored_people_are_shared_out_without_overlap(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="smoke", method="SBI")
    place = Workplace(folder=tmp_path, sources=Sources())
    case = Case.of(cell, place.sources, place.cache, "cpu")
    assert case.held_out is not None
    held_out = set(case.held_out[0][:, 0].tolist())
    for pairs in (case.simulations, case.stored):
        assert held_out.isdisjoint(pairs[0][:, 0].tolist())
    cells = [replace(cell, method=method) for method in ("prior", "SBI")]
    assert run_cells(cells, place)["finished"] == 2


@pytest.mark.medium
def test_the_test_set_is_as_large_as_what_is_recorded(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="standard", method="prior")
    case = Case.of(cell, Sources(), Cache(tmp_path), "cpu")
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
        case = Case.of(one, sources, Cache(tmp_path), "cpu")
        simulated = {tuple(theta) for theta in case.stored[0].tolist()}
        # In neither is anyone both simulated and observed.
        for theta, _ in (case.calibration, case.test_set):
            assert simulated.isdisjoint(map(tuple, theta.tolist()))


@pytest.mark.medium
def test_what_is_finished_is_not_computed_again(
    suite_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", str(suite_file), "--out", str(tmp_path), "--method", "prior"]
    main(command)
    (before,) = (tmp_path / "cells").glob("*.json")
    modified = before.stat().st_mtime_ns
    capsys.readouterr()
    main(command)
    assert "1 kept, 0 finished, 0 failed" in capsys.readouterr().out
    assert before.stat().st_mtime_ns == modified
    main([*command, "--again"])
    assert before.stat().st_mtime_ns > modified


def children_of(process: subprocess.Popen[Any]) -> list[Any]:
    psutil = pytest.importorskip("psutil")
    return psutil.Process(process.pid).children(recursive=True)


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_table(
    suite_file: Path, uninterrupted: list[dict[str, str]], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "benchmarks", "run", str(suite_file)]
    command += ["--out", str(tmp_path), "--jobs", "2"]
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    cells = tmp_path / "cells"
    while len(list(cells.glob("*.json"))) < 2:
        assert process.poll() is None, (tmp_path / "output").read_text()
        time.sleep(0.05)
    workers = children_of(process)
    assert len(workers) >= 2
    for one in (process, *workers):
        one.kill()
    process.wait()
    finished = {path: path.stat().st_mtime_ns for path in cells.glob("*.json")}
    assert 2 <= len(finished) < len(uninterrupted)
    damaged = sorted(finished)[0].with_suffix(".npz")
    damaged.write_bytes(damaged.read_bytes()[:100])

    again = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert "is damaged and is computed again" in again.stderr
    assert damaged.with_name(f"{damaged.name}.damaged-1").exists()
    kept = len(finished) - 1
    assert f"{kept} kept, {len(uninterrupted) - kept} finished" in again.stdout
    for path, modified in finished.items():
        computed_again = path.stat().st_mtime_ns != modified
        assert computed_again == (path.stem == damaged.stem)
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
        assert "failed: sir HVAE n_c=10 #0: ValueError: HVAE is only for" in printed
    assert main([*command, "--method", "prior"]) == 0


def test_methods_see_the_same_data_and_repetitions_do_not(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="NPE", n_calibration=10)
    cases = [
        Case.of(other, Sources(), Cache(tmp_path), "cpu")
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
    return Case.of(cell, Sources(), Cache(folder), "cpu")


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
    (score,) = scores(replace(case, cell=cell), [cell], [cell])
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
    assert torch.equal(ours[0], score.evaluation.lpp.log_probs)


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
    assert len(method.build_posterior().posterior_estimator.parts) == 2
    # The corrected NPE is the start: the discrepancy was fitted, too.
    assert method.discrepancy.num_pairs == 10
