"""Reading the causal chambers' tables and images, and getting them whole."""

import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sbi_rope.tasks.chambers import (
    find_file,
    read_columns,
    read_images,
)
from sbi_rope.utils.errors import DataNotFoundError, InvalidInputError

DATASET = "lt_camera_v1"
SENSORS = "lt_interventions_standard_v1"
FILE = Path(DATASET, "first_1.8", "first_1.8.csv")
Unpack = Callable[[Path], None]


def unpack(folder: Path) -> None:
    """Write what a whole download unpacks."""
    path = folder / FILE
    path.parent.mkdir(parents=True)
    path.write_text("a,b\n1,2\n")


def write_image(path: Path, pixels: Tensor) -> None:
    """Write pixels (3, height, width) in the format of the file's extension."""
    image_module = pytest.importorskip("PIL.Image")
    _, height, width = pixels.shape
    content = pixels.permute(1, 2, 0).contiguous().numpy().tobytes()
    image = image_module.frombytes("RGB", (width, height), content)
    image.save(path)


def random_image(size: int = 16) -> Tensor:
    return torch.randint(256, (3, size, size), dtype=torch.uint8)


# Files and tables --------------------------------------------------------------------


def test_missing_files_columns_and_numbers_are_named(tmp_path: Path) -> None:
    for root in (None, tmp_path):
        with pytest.raises(DataNotFoundError, match=rf"{FILE}.*download=True"):
            find_file(FILE, root=root)
    path = tmp_path / "t.csv"
    for text, match in (
        ("a\n1\n", r"\['b'\] are missing"),
        ("a,b\n", "at least one number"),
        ("a,b\n1,dark\n", "to be finite.*1 of 1 rows"),
        ("a,b\n1,2\n3\n", "to be finite.*1 of 2 rows"),
    ):
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=rf"t\.csv.*{match}"):
            read_columns(path, ["a", "b"])


# Images ------------------------------------------------------------------------------


def test_images_are_read_channels_first_in_the_order_asked_for(tmp_path: Path) -> None:
    written = {f"{i}.png": random_image() for i in range(3)}
    for name, pixels in written.items():
        write_image(tmp_path / name, pixels)
    images = read_images(tmp_path, ["2.png", "0.png"], 16)
    assert images.dtype == torch.uint8
    assert torch.equal(images, torch.stack([written["2.png"], written["0.png"]]))
    assert read_images(tmp_path, [], 16).shape == (0, 3, 16, 16)


# Downloads ---------------------------------------------------------------------------


def test_the_extract_is_the_beginning_of_the_published_files(
    chamber_root: Path, chamber_extract: Path
) -> None:
    extracts = list((chamber_extract / SENSORS).glob("*.csv"))
    assert len(extracts) == 14
    for extract in extracts:
        published = (chamber_root / SENSORS / extract.name).read_bytes()
        assert published.startswith(extract.read_bytes())


def test_a_download_puts_the_whole_data_set_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = stub_downloads(monkeypatch, unpack)
    root = tmp_path / "new" / "root"
    assert find_file(FILE, root=root, download=True) == root / FILE
    assert find_file(FILE, root=root, download=True).read_text() == "a,b\n1,2\n"
    assert calls == [DATASET]
    assert [path.name for path in root.iterdir()] == [DATASET]


def stub_downloads(monkeypatch: pytest.MonkeyPatch, action: Unpack) -> list[str]:
    """Replace causalchamber's downloads by an action, and record the calls."""
    calls: list[str] = []

    class Dataset:
        def __init__(self, name: str, root: str, download: bool = True) -> None:
            assert download
            calls.append(name)
            action(Path(root))

    module = types.ModuleType("causalchamber.datasets")
    module.Dataset = Dataset  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "causalchamber", types.ModuleType("causalchamber"))
    monkeypatch.setitem(sys.modules, "causalchamber.datasets", module)
    return calls
