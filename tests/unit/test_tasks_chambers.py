"""Reading the causal chambers' tables, and getting them whole."""

import sys
import types
from pathlib import Path

import pytest

from sbi_rope.tasks.chambers import find_file, read_columns
from sbi_rope.utils.errors import DataNotFoundError, InvalidInputError

FILE = Path("lt_camera_v1", "first_1.8", "first_1.8.csv")


def test_missing_files_columns_and_numbers_are_named(tmp_path: Path) -> None:
    for root in (None, tmp_path):
        with pytest.raises(DataNotFoundError, match=rf"{FILE}.*download=True"):
            find_file(FILE, root=root)
    path = tmp_path / "t.csv"
    for text, match in (
        ("a\n1\n", r"\['b'\] are missing"),
        ("a,b\n", "at least one number"),
        ("a,b\n1,dark\n", "to be finite.*1 of 1 rows"),
    ):
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=rf"t\.csv.*{match}"):
            read_columns(path, ["a", "b"])


def test_a_download_puts_the_whole_data_set_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def download(name: str, root: str, download: bool) -> None:
        """Stand in for causalchamber, and unpack what it downloads."""
        assert download
        calls.append(name)
        path = Path(root) / FILE
        path.parent.mkdir(parents=True)
        path.write_text("a,b\n1,2\n")

    module = types.ModuleType("causalchamber.datasets")
    module.Dataset = download  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "causalchamber", types.ModuleType("causalchamber"))
    monkeypatch.setitem(sys.modules, "causalchamber.datasets", module)
    root = tmp_path / "new" / "root"
    assert find_file(FILE, root=root, download=True) == root / FILE
    assert find_file(FILE, root=root, download=True).read_text() == "a,b\n1,2\n"
    assert calls == [FILE.parts[0]]
    assert [path.name for path in root.iterdir()] == [FILE.parts[0]]
