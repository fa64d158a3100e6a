"""The command that lists, describes and draws tasks."""

from pathlib import Path

import pytest
import torch

from sbi_rope.tasks import get_task, list_tasks
from sbi_rope.tasks.__main__ import _state_of_data, main

PNG = b"\x89PNG"


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sbi_rope.tasks.__main__.BUDGET", 0.0)


@pytest.mark.medium
def test_the_list_has_a_line_for_every_task_and_says_whether_its_data_are_there(
    capsys: pytest.CaptureFixture[str], chamber_extract: Path, tmp_path: Path
) -> None:
    assert main([]) == 0
    lines = {
        line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line
    }
    assert set(list_tasks()) <= set(lines)
    assert "recorded, no --root" in lines["light_tunnel_sensors"]
    assert lines["pendulum"].split()[1:4] == ["2", "200", "drawn"]
    assert int(lines["pendulum"].split()[-1].replace(",", "")) > 0
    sensors = "light_tunnel_sensors"
    assert _state_of_data(get_task(sensors, root=chamber_extract)) == "recorded, found"
    assert _state_of_data(get_task(sensors, root=tmp_path)) == "recorded, missing"


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


# One task each of statistics, series and images.
@pytest.mark.medium
@pytest.mark.parametrize("name", ["cs", "pendulum", "light_tunnel"])
def test_a_task_is_described_and_drawn(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "new" / "x.png"
    arguments = [name, "-n", "50", "--variant", "well_specified", "--plot", str(path)]
    assert main(arguments) == 0
    assert path.read_bytes().startswith(PNG)
    out = capsys.readouterr().out
    assert "prior (50 draws)" in out
    assert "simulated x (50 draws)" in out
    assert "well-specified x (50 test observations)" in out
    assert "prior_shift: " in out


def test_errors_are_one_line_and_a_status(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments, word in (
        (["pendulu"], "'pendulum'"),
        (["pendulum", "-n", "0"], "`n`"),
        (["light_tunnel_sensors", "-n", "9", "--plot", "x.png"], "`root`"),
    ):
        assert main(arguments) == 2
        captured = capsys.readouterr()
        assert word in captured.err
        assert "Traceback" not in captured.err
    assert not list(tmp_path.iterdir())
