"""The command that lists, describes and draws tasks."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sbi_rope.tasks import list_tasks
from sbi_rope.tasks.__main__ import main
from tests.fresh import imported_anew

PNG = b"\x89PNG"


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sbi_rope.tasks.__main__.BUDGET", 0.0)


def test_the_list_has_a_line_for_every_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    lines = {
        line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line
    }
    assert set(list_tasks()) <= set(lines)
    assert "no --root" in lines["light_tunnel_sensors"]
    assert lines["pendulum"].split()[1:4] == ["2", "200", "drawn"]
    assert int(lines["pendulum"].split()[-1].replace(",", "")) > 0


def test_the_list_says_whether_recorded_data_are_there(
    capsys: pytest.CaptureFixture[str], chamber_root: Path, tmp_path: Path
) -> None:
    main(["--root", str(chamber_root)])
    assert "recorded, found" in capsys.readouterr().out
    main(["--root", str(tmp_path)])
    assert "recorded, missing" in capsys.readouterr().out


@pytest.mark.parametrize("name", list_tasks())
def test_a_task_is_described(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [name, "-n", "50", "--variant", "well_specified"]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "prior (50 draws)" in out
    assert "simulated x (50 draws)" in out
    assert "well-specified x (50 test observations)" in out
    assert "prior_shift: " in out


def test_summaries_are_those_of_the_draws(capsys: pytest.CaptureFixture[str]) -> None:
    main(["linear_gaussian", "-n", "4000"])
    row = next(
        line for line in capsys.readouterr().out.splitlines() if "theta_1 " in line
    )
    mean, std, _, low, median, high, _ = map(float, row.split()[1:])
    assert mean == pytest.approx(0.0, abs=0.07)
    assert std == pytest.approx(1.0, abs=0.05)
    normal = torch.distributions.Normal(0.0, 1.0)
    expected = [float(normal.icdf(torch.tensor(q))) for q in (0.25, 0.5, 0.75)]
    assert [low, median, high] == pytest.approx(expected, abs=0.08)


def test_without_data_the_missing_file_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["light_tunnel_sensors", "-n", "50"]) == 0
    out = capsys.readouterr().out
    assert "uniform_reference.csv not found" in out
    assert "real x (" not in out


@pytest.mark.parametrize("name", list_tasks())
def test_a_picture_is_written(name: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "new" / "x.png"
    arguments = [name, "-n", "50", "--variant", "well_specified", "--plot", str(path)]
    assert main(arguments) == 0
    assert path.read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        pytest.param(["pendulu"], "'pendulum'", id="name"),
        pytest.param(["pendulum", "--variant", "no"], "prior_shift", id="variant"),
        pytest.param(["pendulum", "-n", "0"], "`n`", id="n"),
        pytest.param(["pendulum", "-n", "9", "--plot", "x.doc"], "x.doc", id="format"),
        pytest.param(
            ["light_tunnel_sensors", "-n", "9", "--plot", "x.png"], "`root`", id="data"
        ),
    ],
)
def test_errors_are_one_line_and_a_status(
    arguments: list[str],
    match: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert match in captured.err
    assert "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_picture_without_a_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        main(["--plot", str(tmp_path / "x.png")])


def test_the_module_runs_as_a_command(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["tasks", "linear_gaussian", "-n", "20"])
    # As by `python -m`, in this process.
    with imported_anew(), pytest.raises(SystemExit) as end:
        runpy.run_module("sbi_rope.tasks", run_name="__main__", alter_sys=True)
    assert end.value.code in (None, 0)
    out, err = capfd.readouterr()
    assert "linear_gaussian" in out or "LinearGaussian" in out
    assert err == ""


@pytest.mark.slow
def test_the_module_runs_as_a_command_of_its_own() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sbi_rope.tasks", "linear_gaussian", "-n", "20"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "linear_gaussian" in done.stdout or "LinearGaussian" in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize("name", ["light_tunnel", "wind_tunnel"])
def test_a_stand_in_is_called_one(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "-n", "20", "--stand-in", "--variant", "prior_shift"]) == 0
    out = capsys.readouterr().out
    assert "stand-in x (20 test observations)" in out
    assert "stand_in=True" in out


@pytest.mark.parametrize("plot", ["noformat", "file/x.png"])
def test_a_picture_that_cannot_be_written_is_explained(
    plot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["pendulum", "-n", "9", "--plot", str(tmp_path / plot)]) == 2
    assert "Traceback" not in capsys.readouterr().err
