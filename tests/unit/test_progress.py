"""Progress bars are shown in terminals, and do not fill log files."""

import subprocess
import sys
from pathlib import Path

import pytest

from sbi_rope._progress import progress_bar

TRAIN = """
import warnings
from sbi_rope import CalibrationFinetuner, RoPE
from tests import gaussian

warnings.simplefilter("ignore")
rope = RoPE(
    gaussian.posterior(),
    simulator=gaussian.simulator,
    finetuner=CalibrationFinetuner(max_num_epochs=200, rehearsal=0.5),
)
rope.append_calibration(*gaussian.labelled(20)).train()
assert rope.history.best_epoch > 0
rope.build_posterior(gaussian.labelled(30)[1])
"""


@pytest.mark.slow
def test_training_into_a_log_file_writes_next_to_nothing(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with log.open("wb") as file:
        run = subprocess.run(
            [sys.executable, "-c", TRAIN],
            stdout=file,
            stderr=file,
            cwd=Path(__file__).parents[2],
            check=False,
        )
    assert run.returncode == 0, log.read_text()
    assert log.stat().st_size < 1000


def test_a_bar_is_shown_in_a_terminal_if_it_is_asked_for(
    terminal: pytest.CaptureFixture[str],
) -> None:
    for show in (True, False):
        assert list(progress_bar(range(3), show=show, desc="Counting")) == [0, 1, 2]
        with progress_bar(show=show, desc="By hand", total=2) as bar:
            bar.update(2)
        printed = terminal.readouterr()
        assert ("Counting" in printed.err) is show
        assert ("By hand: 100%" in printed.err) is show
        assert printed.out == ""


def test_without_a_terminal_there_is_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress_bar(range(3), show=True, desc="Counting")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
