"""What the example scripts write."""

from pathlib import Path

import pytest

from sbi_rope import SinkhornCoupler
from sbi_rope.tasks import get_task


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


def test_a_folder_that_cannot_be_made_is_named_before_any_work(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from examples.study import Study

    (tmp_path / "file").touch()
    study = Study(
        task=get_task("linear_gaussian"),
        train_npe=lambda task, seed: pytest.fail("began to work"),
        coupler=SinkhornCoupler(),
        seeds=[0],
        n_calibration=[5],
        n_test=5,
        out=tmp_path / "file" / "folder",
    )
    with pytest.raises(SystemExit, match="Cannot write to"):
        study.run()
