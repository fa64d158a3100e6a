"""What the example scripts write."""

from pathlib import Path

import pytest


def test_older_results_are_set_aside_and_none_is_overwritten(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from examples.study import ResultsFile

    path = tmp_path / "results.csv"
    path.write_text("last time")
    (tmp_path / "results_2.csv").write_text("kept by hand")
    ResultsFile(path)
    ResultsFile(path)
    assert (tmp_path / "results_1.csv").read_text() == "last time"
    assert (tmp_path / "results_2.csv").read_text() == "kept by hand"
    assert (tmp_path / "results_3.csv").exists()
