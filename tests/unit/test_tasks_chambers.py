"""Reading the causal chambers' tables and images, and getting them whole."""

import sys
import types
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sbi_rope.errors import DataNotFoundError, InvalidInputError, RoPEWarning
from sbi_rope.tasks import chambers, get_task
from sbi_rope.tasks.chambers import (
    KNOWN_ARCHIVES,
    check_complete,
    check_download,
    find_file,
    find_images,
    read_columns,
    read_images,
    read_names,
    read_table,
)
from sbi_rope.tasks.light_tunnel_sensors import LightTunnelSensors
from tests.chamber_files import write_camera_experiments, write_impulses

DATASET = "lt_camera_v1"
SENSORS = "lt_interventions_standard_v1"
FILE = Path(DATASET, "first_1.8", "first_1.8.csv")
Unpack = Callable[[Path], None]


def unpack(folder: Path) -> None:
    """Write what a whole download unpacks."""
    path = folder / FILE
    path.parent.mkdir(parents=True)
    path.write_text("a,b\n1,2\n")


def write_image(path: Path, pixels: Tensor, *, mode: str = "RGB") -> None:
    """Write pixels (3, height, width) in the format of the file's extension."""
    image_module = pytest.importorskip("PIL.Image")
    _, height, width = pixels.shape
    content = pixels.permute(1, 2, 0).contiguous().numpy().tobytes()
    image = image_module.frombytes("RGB", (width, height), content)
    image.convert(mode).save(path, quality=95)


def random_image(size: int = 16) -> Tensor:
    return torch.randint(256, (3, size, size), dtype=torch.uint8)


# Files and tables --------------------------------------------------------------------


def test_a_file_is_found_below_the_root(tmp_path: Path) -> None:
    unpack(tmp_path)
    assert find_file(FILE, root=tmp_path) == tmp_path / FILE


def test_without_a_root_the_file_and_the_ways_to_get_it_are_named() -> None:
    with pytest.raises(DataNotFoundError, match=r"no `root`.*download=True") as error:
        find_file(FILE, root=None)
    assert str(FILE) in str(error.value)
    assert f"causal-chamber/tree/main/datasets/{DATASET}" in str(error.value)


def test_the_message_about_a_missing_file_says_what_is_there(tmp_path: Path) -> None:
    unpack(tmp_path)
    (tmp_path / DATASET / "table_0.5.csv").write_text("")
    (tmp_path / DATASET / "LICENSE.txt").write_text("")
    for root, file, match in (
        ("gone", FILE, r"There is no folder .*gone\."),
        ("", Path("x_v1/x.csv"), r"no folder .*x_v1\."),
        (
            "",
            Path(DATASET, "b", "b.csv"),
            r"The data set has \['first_1.8', 'table_0.5'\]",
        ),
    ):
        with pytest.raises(DataNotFoundError, match=match):
            find_file(file, root=tmp_path / root)


def test_columns_come_in_the_order_asked_for(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b,c\n1,2,x\n3,4,y\n")
    values = read_columns(tmp_path / "t.csv", ["b", "a"])
    assert torch.equal(
        values, torch.tensor([[2.0, 1.0], [4.0, 3.0]], dtype=torch.float64)
    )
    assert read_names(tmp_path / "t.csv", "c") == ["x", "y"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("a\n1\n", r"\['b'\] are missing.*get it again"),
        ("a,b\n", "to have rows.*get it again"),
        ("", "CSV table.*get it again"),
        ("a,b\n1,2\n3\n4,5\n", "row 1 ends in the column 'a'"),
        ("a,b\n1,2\n3,4", "last row, 1, ends in the column 'b'"),
        ("a,b\n1,dark\n", "finite.*row 0 has 'dark'.*'b'"),
        ("a,b\n1,2\n3,\n", "finite.*row 1 has 'nan'.*'b' .1 such"),
        ("a,b\n-1e39,2\n", "row 0 has '-1e.39' in the column 'a'"),
    ],
)
def test_a_damaged_table_is_refused_with_the_place_of_the_damage(
    tmp_path: Path, text: str, match: str
) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InvalidInputError, match=rf"t\.csv.*{match}"):
        read_columns(tmp_path / "t.csv", ["a", "b"])


def test_a_table_without_pandas_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"need pandas.*sbi-rope\[benchmarks\]"):
        read_table(tmp_path / "t.csv", ["a"])


def test_rows_without_a_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b\n1,one.png\n2,\n")
    with pytest.raises(InvalidInputError, match=r"column 'b'; the rows \[1\]"):
        read_names(tmp_path / "t.csv", "b")


# Images ------------------------------------------------------------------------------


def test_images_are_read_channels_first_in_the_order_asked_for(tmp_path: Path) -> None:
    written = {f"{i}.png": random_image() for i in range(3)}
    for name, pixels in written.items():
        write_image(tmp_path / name, pixels)
    images = read_images(tmp_path, ["2.png", "0.png"], 16)
    assert images.dtype == torch.uint8
    assert torch.equal(images, torch.stack([written["2.png"], written["0.png"]]))
    assert read_images(tmp_path, [], 16).shape == (0, 3, 16, 16)


def test_compressed_photographs_can_be_read(tmp_path: Path) -> None:
    pixels = torch.tensor([200, 100, 50], dtype=torch.uint8)[:, None, None]
    write_image(tmp_path / "0.jpg", pixels.expand(3, 16, 16))
    image = read_images(tmp_path, ["0.jpg"], 16)[0]
    assert (image.int() - pixels.int()).abs().max() <= 3


def test_a_missing_image_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"7\.png.*get it again"):
        read_images(tmp_path, ["7.png"], 16)


@pytest.mark.parametrize("extension", ["png", "jpg"])
def test_an_image_that_was_cut_anywhere_is_refused_or_read_as_the_whole(
    tmp_path: Path, extension: str
) -> None:
    path = tmp_path / f"0.{extension}"
    write_image(path, random_image())
    content, whole = path.read_bytes(), read_images(tmp_path, [path.name], 16)
    refused = 0
    lengths = {*range(0, len(content), 4), *range(len(content) - 20, len(content))}
    for length in lengths:
        path.write_bytes(content[:length])
        try:
            image = read_images(tmp_path, [path.name], 16)
        except InvalidInputError as error:
            assert str(path) in str(error)  # noqa: PT017
            assert "get it again" in str(error)  # noqa: PT017
            refused += 1
        else:
            assert torch.equal(image, whole), length
    assert refused > 0.9 * len(lengths)


def test_an_image_of_another_size_or_mode_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "0.png", random_image())
    for size in (8, 17):
        match = rf"0\.png.*{size} x {size} pixels in mode RGB; got 16 x 16"
        with pytest.raises(InvalidInputError, match=match):
            read_images(tmp_path, ["0.png"], size)
    for mode in ("L", "RGBA", "P", "1"):
        write_image(tmp_path / "0.png", random_image(), mode=mode)
        match = rf"0\.png.*RGB; got .*mode {mode}\."
        with pytest.raises(InvalidInputError, match=match):
            read_images(tmp_path, ["0.png"], 16)


def test_the_message_about_a_missing_size_lists_the_sizes_there_are(
    tmp_path: Path,
) -> None:
    for name in ("images_100", "images_full", "other"):
        (tmp_path / DATASET / "first" / name).mkdir(parents=True)
    experiment = tmp_path / DATASET / "first"
    assert find_images(experiment, 100) == experiment / "images_100"
    with pytest.raises(DataNotFoundError, match=r"images_64.*\['100', 'full'\]"):
        find_images(experiment, 64)


# Downloads ---------------------------------------------------------------------------


def test_a_download_needs_a_root() -> None:
    with pytest.raises(InvalidInputError, match=r"`root` with `download=True`"):
        check_download(None, [Path("a/b.csv")], download=True)
    check_download(None, [Path("a/b.csv")], download=False)
    check_download(None, [], download=True)
    check_download(Path("root"), [Path("a/b.csv")], download=True)


def test_a_published_experiment_must_have_as_many_rows_as_were_published() -> None:
    for dataset, name, whole in (
        (DATASET, "uniform_ap_8.0_iso_500.0", [10_000]),
        (DATASET, "betab_ap_1.8_iso_500.0", [10_000]),
        (DATASET, "scm_1_red", [5000]),
        (SENSORS, "uniform_reference", [6000, 10_000]),
        (SENSORS, "uniform_v_c_strong", [1000]),
        ("wt_intake_impulse_v1", "load_out_1_osr_downwind_4", [250_000]),
    ):
        path = Path(f"{name}.csv")
        for rows in whole:
            check_complete(path, rows, dataset=dataset)
            for found in (1, rows - 1, rows + 1, rows - 50):
                match = rf"{name}.csv.*row {found - 1},"
                with pytest.raises(InvalidInputError, match=match):
                    check_complete(path, found, dataset=dataset)
        check_complete(Path("an_experiment_of_ones_own.csv"), 3, dataset=dataset)


@pytest.mark.parametrize("name", ["uniform_reference", "uniform_t_ir_1_strong"])
def test_a_recording_that_was_cut_anywhere_is_refused(
    chamber_extract: Path, tmp_path: Path, name: str
) -> None:
    published = (chamber_extract / SENSORS / f"{name}.csv").read_bytes()
    rows = published.splitlines(keepends=True)
    middle = len(rows) // 2
    path = tmp_path / SENSORS / f"{name}.csv"
    path.parent.mkdir()
    task = LightTunnelSensors(
        root=tmp_path, experiment=None if name == "uniform_reference" else name
    )
    path.write_bytes(published)
    assert task.num_recorded("test") == -(-2 * (len(rows) - 1) // 3)
    for cut in (
        published[:-1],
        published[:-2],
        published[: len(published) * 2 // 3],
        published[:-1] + b",\n" + rows[-1][:90],
        b"".join(rows[:-1]),
        b"".join(rows[: middle + 1]),
        b"".join(rows[:middle] + rows[middle + 5 :]),
        b"".join([*rows[:middle], rows[middle][:200], *rows[middle + 1 :]]),
    ):
        path.write_bytes(cut)
        with pytest.raises(
            InvalidInputError, match=rf"{name}.csv.*(row|line).*get it again"
        ):
            task.get_test_set(1)


def test_the_extract_is_the_beginning_of_the_published_files(
    chamber_root: Path, chamber_extract: Path
) -> None:
    extracts = list((chamber_extract / SENSORS).glob("*.csv"))
    assert len(extracts) == 14
    for extract in extracts:
        published = (chamber_root / SENSORS / extract.name).read_bytes()
        assert published.startswith(extract.read_bytes())


@pytest.mark.medium
@pytest.mark.usefixtures("shorter_files")
@pytest.mark.parametrize("name", ["light_tunnel", "wind_tunnel"])
def test_no_file_is_read_that_ends_within_a_row(name: str, tmp_path: Path) -> None:
    if name == "light_tunnel":
        write_camera_experiments(tmp_path, num_rows=3)
    else:
        write_impulses(tmp_path, num_impulses=3)
    options = {"image_size": 64} if name == "light_tunnel" else {}
    task = get_task(name, root=tmp_path, **options)
    path = tmp_path / task.required_files[0]
    whole = path.read_bytes()
    task.get_test_set(1)
    for cut in range(1, len(whole.splitlines()[-1]) + 1):
        path.write_bytes(whole[:-cut])
        with pytest.raises(InvalidInputError, match="ends in the column"):
            task.get_test_set(1)


def test_rows_that_end_with_a_comma_are_not_shifted(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,b\n1,2,\n3,4,\n")
    assert read_columns(path, ["a", "b"]).tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_a_download_puts_the_whole_data_set_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = stub_downloads(monkeypatch, unpack)
    root = tmp_path / "new" / "root"
    assert find_file(FILE, root=root, download=True) == root / FILE
    assert find_file(FILE, root=root, download=True).read_text() == "a,b\n1,2\n"
    assert calls == [DATASET]
    assert [path.name for path in root.iterdir()] == [DATASET]


def test_nothing_is_downloaded_unless_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = stub_downloads(monkeypatch, unpack)
    with pytest.raises(DataNotFoundError):
        find_file(FILE, root=tmp_path)
    assert calls == []


@pytest.mark.parametrize(
    ("failure", "seen"),
    [
        pytest.param(OSError("disk full"), DataNotFoundError, id="disk"),
        pytest.param(
            Exception("Checksum does not match!"), DataNotFoundError, id="md5"
        ),
        pytest.param(KeyboardInterrupt(), KeyboardInterrupt, id="interrupt"),
        pytest.param(SystemExit(), SystemExit, id="exit"),
    ],
)
def test_a_download_cut_off_half_way_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    failure: BaseException,
    seen: type[BaseException],
) -> None:
    def break_off(folder: Path) -> None:
        unpack(folder)
        raise failure

    stub_downloads(monkeypatch, break_off)
    with pytest.raises(seen) as error:
        find_file(FILE, root=tmp_path, download=True)
    if seen is DataNotFoundError:
        assert str(failure) in str(error.value)
        assert "Nothing of it was kept" in str(error.value)
    assert list(tmp_path.iterdir()) == []
    # The next attempt starts anew.
    stub_downloads(monkeypatch, unpack)
    assert find_file(FILE, root=tmp_path, download=True).is_file()


def test_an_unfinished_download_of_an_earlier_process_is_not_taken_for_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpack(tmp_path / ".download_killed")
    with pytest.raises(DataNotFoundError, match="no folder"):
        find_file(FILE, root=tmp_path)
    calls = stub_downloads(monkeypatch, unpack)
    assert find_file(FILE, root=tmp_path, download=True).is_file()
    assert calls == [DATASET]


def test_a_data_set_that_exists_is_neither_overwritten_nor_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = stub_downloads(monkeypatch, unpack)
    other = tmp_path / DATASET / "own" / "own.csv"
    other.parent.mkdir(parents=True)
    other.write_text("mine")
    with pytest.raises(
        DataNotFoundError, match=rf"\['own'\].*without a folder {DATASET}"
    ):
        find_file(FILE, root=tmp_path, download=True)
    assert calls == []
    assert other.read_text() == "mine"
    assert not (tmp_path / FILE).exists()


def test_a_download_without_the_data_set_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub_downloads(monkeypatch, lambda folder: None)
    with pytest.raises(DataNotFoundError, match=f"Could not download {DATASET}"):
        find_file(FILE, root=tmp_path, download=True)
    assert list(tmp_path.iterdir()) == []


def test_without_the_internet_the_message_names_the_page_to_download_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def offline(module: str) -> None:
        raise ConnectionError(f"{module}: no route to host")

    monkeypatch.setattr(chambers, "import_module", offline)
    with pytest.raises(DataNotFoundError, match=r"no route.*causal-chamber/tree/main"):
        find_file(FILE, root=tmp_path, download=True)


def test_a_download_without_the_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "causalchamber", None)
    monkeypatch.setitem(sys.modules, "causalchamber.datasets", None)
    with pytest.raises(ImportError, match=r"need causalchamber\.datasets.*pip install"):
        find_file(FILE, root=tmp_path, download=True)


def test_a_data_set_that_was_published_anew_is_downloaded_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub_downloads(monkeypatch, unpack, published="0123")
    with pytest.warns(RoPEWarning, match=rf"{DATASET} has changed since.*0123") as seen:
        find_file(FILE, root=tmp_path, download=True)
    assert seen[0].filename == __file__


@pytest.mark.parametrize("published", [None, KNOWN_ARCHIVES[DATASET]])
def test_the_known_data_set_is_downloaded_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, published: str | None
) -> None:
    stub_downloads(monkeypatch, unpack, published=published)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_file(FILE, root=tmp_path, download=True)


def stub_downloads(
    monkeypatch: pytest.MonkeyPatch, action: Unpack, *, published: str | None = None
) -> list[str]:
    """Replace causalchamber's downloads by an action, and record the calls."""
    calls: list[str] = []

    class Dataset:
        def __init__(self, name: str, root: str, download: bool = True) -> None:
            assert download
            calls.append(name)
            action(Path(root))

    module = types.ModuleType("causalchamber.datasets")
    module.Dataset = Dataset  # type: ignore[attr-defined]
    if published is not None:
        module.directory = {"datasets": {DATASET: {"md5": published}}}  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "causalchamber", types.ModuleType("causalchamber"))
    monkeypatch.setitem(sys.modules, "causalchamber.datasets", module)
    return calls
