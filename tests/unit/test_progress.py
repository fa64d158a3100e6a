"""Progress bars are shown in terminals, and do not fill log files."""

import sys
from typing import Any

import pytest

from sbi_rope import CalibrationFinetuner, RoPE, stack
from sbi_rope.utils.progress import is_shown
from tests import baselines, gaussian
from tests.stacks import BOX, NPE, PRIOR, quick


def test_bars_are_shown_by_default_where_they_can_be_redrawn(
    terminal: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_shown(None)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: False)
    assert not is_shown(None)
    assert is_shown(True)
    monkeypatch.setattr("sys.stderr", None)  # as of a program without a console
    assert not is_shown(None)


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
        chosen = (PRIOR, NPE, BOX)
        stack(trained, candidates=chosen, num_folds=2, **show)
    method = baselines.make("tuning_only", "linear_gaussian")
    data = baselines.data_of("linear_gaussian")
    baselines.feed(method, data).train(**show).build_posterior()


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
        "Training neural network. Epochs trained: 3",
    )
    assert [bar for bar in bars if bar not in printed.err] == []
