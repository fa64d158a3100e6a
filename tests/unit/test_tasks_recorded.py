"""Reading recorded tables, getting them whole, and the two tasks that were measured."""

import math
import sys
import types
from pathlib import Path

import pytest
import torch

from sbi_rope.tasks import get_task
from sbi_rope.tasks.chambers import find_file, read_columns
from sbi_rope.tasks.near_infrared import NearInfraredSimulator, spectra
from sbi_rope.tasks.ocean_colour import OceanColourSimulator
from sbi_rope.utils.errors import DataNotFoundError, InvalidInputError
from tests.tasks import MEASURED, make, skip_without_data

FILE = Path("lt_camera_v1", "first_1.8", "first_1.8.csv")


def test_missing_files_columns_and_numbers_are_named(tmp_path: Path) -> None:
    for root in (None, tmp_path):
        with pytest.raises(DataNotFoundError, match=rf"{FILE}.*download=True"):
            find_file(FILE, root=root)
    for name in MEASURED:
        with pytest.raises(DataNotFoundError, match=r"Get it from http"):
            get_task(name, root=tmp_path).get_test_set(3)
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


def test_the_sea_has_the_reflectance_of_the_textbook() -> None:
    simulator = OceanColourSimulator(scatter=0.0, relative_noise=0.0)
    # 443 nm, where the uncertain slope plays no part; 1 and 10 mg of chlorophyll.
    for log_c, power in ((0.0, -0.15), (1.0, 0.0)):
        c = 10**log_c
        absorbed = 0.0071 + 0.06 * c**0.65 * 0.983 + 0.1
        share = 0.002 + 0.01 * (0.5 - 0.25 * log_c) * (443 / 550) ** power
        back = 0.00144 * (443 / 500) ** -4.32 + 0.416 * c**0.766 * share
        u = back / (absorbed + back)
        below = 0.0895 * u + 0.1247 * u**2
        expected = math.log10(0.52 * below / (1 - 1.7 * below))
        found = simulator(torch.tensor([[log_c, -1.0]]))[0, 1]
        assert float(found) == pytest.approx(expected, abs=1e-5)


def test_a_spectrum_is_a_mixture_whatever_its_path_and_mean() -> None:
    simulator = NearInfraredSimulator(slope_std=0.0, noise_std=0.0)
    theta = torch.tensor([[60.0, 20.0, 18.0]])
    mixed = (theta.double() / 100 @ spectra())[0] / math.log(10)
    tilt = -0.05 * torch.linspace(-1.0, 0.98, 100).double()
    for found in simulator(theta.repeat(3, 1)).double():
        assert float(found.mean()) == pytest.approx(0.0, abs=1e-5)
        assert float(found.square().mean()) == pytest.approx(1.0, abs=1e-5)
        # The path is the only unknown: a combination of mixture, tilt and constant.
        design = torch.stack([mixed, tilt, torch.ones_like(tilt)], dim=1)
        solution = torch.linalg.lstsq(design, found[:, None]).solution[:, 0]
        assert torch.allclose(design @ solution, found, atol=1e-4)
        assert 1.5 <= float(solution[0] / solution[1]) <= 6.0
    # Water absorbs most at 975 nm, and fat has a band at 930 nm.
    assert spectra().argmax(dim=1)[:2].tolist() == [62, 40]


def test_no_cruise_and_no_sample_is_in_both_sets() -> None:
    for name, variant in (("near_infrared", None), ("ocean_colour", "other_cruises")):
        task = make(name, variant=variant)
        skip_without_data(task)
        pairs = task._real_process("test")
        first, second = (
            {pairs.groups[row] for row in pairs.rows_of(part)}
            for part in ("calibration", "test")
        )
        assert not first & second
        assert first | second == set(pairs.groups)
        # The folder of a folder is searched as well.
        root = None if task.root is None else task.root.parent
        assert get_task(name, root=root).has_data
