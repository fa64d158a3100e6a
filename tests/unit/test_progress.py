"""Progress bars are shown in terminals, and do not fill log files."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sbi_rope import CalibrationFinetuner, RoPE, stack
from sbi_rope._progress import is_shown, progress_bar
from tests import baselines, gaussian
from tests.stacks import FITTED, NPE, PRIOR, quick

TRAIN = """
import warnings
from sbi_rope import CalibrationFinetuner, RoPE, diagnose
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
diagnose(rope, gaussian.labelled(30)[1])
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


def test_bars_are_shown_by_default_where_they_can_be_redrawn(
    terminal: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_shown(None)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: False)
    assert not is_shown(None)
    assert is_shown(True)
    monkeypatch.setattr("sys.stderr", None)  # as of a program without a console
    assert not is_shown(None)


def test_a_bar_is_shown_if_it_is_asked_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for show in (True, False):
        assert list(progress_bar(range(3), show=show, desc="Counting")) == [0, 1, 2]
        with progress_bar(show=show, desc="By hand", total=2) as bar:
            bar.update(2)
        printed = capsys.readouterr()
        assert ("Counting" in printed.err) is show
        assert ("By hand: 100%" in printed.err) is show
        assert printed.out == ""


def rope() -> RoPE:
    finetuner = CalibrationFinetuner(max_num_epochs=3)
    options: dict[str, Any] = {"simulator": gaussian.simulator, "finetuner": finetuner}
    rope = RoPE(gaussian.posterior(), **options)
    return rope.append_calibration(*gaussian.labelled(10))


def work(**show: bool) -> None:
    """Call what a user calls."""
    theta, x_o = gaussian.labelled(30)
    trained = rope().train(**show)
    posterior = trained.build_posterior(x_o, **show)
    posterior.sample_batched((10,), x=x_o, **show)
    posterior[0].sample((10,), **show)
    posterior.log_prob_batched(theta, x=x_o)
    with quick():
        chosen = (PRIOR, NPE, FITTED)
        stack(trained, candidates=chosen, num_folds=2, **show)
    method = baselines.make("tuning_only", "linear_gaussian")
    data = baselines.data_of("linear_gaussian")
    baselines.feed(method, data).train(**show).build_posterior()


@pytest.mark.filterwarnings("ignore")
def test_without_a_terminal_no_call_shows_a_bar_by_default(
    capsys: pytest.CaptureFixture[str],
) -> None:
    work()
    assert capsys.readouterr() == ("", "")


@pytest.mark.filterwarnings("ignore")
def test_no_call_shows_a_bar_in_a_terminal_if_it_is_asked_not_to(
    terminal: pytest.CaptureFixture[str],
) -> None:
    work(show_progress_bars=False)
    assert terminal.readouterr() == ("", "")


@pytest.mark.filterwarnings("ignore")
def test_bars_that_are_asked_for_are_shown_without_a_terminal_and_on_stderr(
    capsys: pytest.CaptureFixture[str],
) -> None:
    work(show_progress_bars=True)
    printed = capsys.readouterr()
    assert printed.out == ""
    bars = (
        "Fine-tuning",
        "Sampling",
        "Training 1 candidates in 3 folds: 100%",
        "Scoring the candidates and the stack on 2 folds: 100%",
        "Training NPE: 3 epochs",
    )
    assert [bar for bar in bars if bar not in printed.err] == []
