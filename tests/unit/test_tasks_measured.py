"""The colour of the sea and the spectra of meat: laws by hand, and what is read."""

import math
from pathlib import Path

import pytest
import torch

from sbi_rope.tasks import get_task
from sbi_rope.tasks.near_infrared import NearInfraredSimulator, spectra
from sbi_rope.tasks.ocean_colour import OceanColourSimulator
from sbi_rope.utils.errors import DataNotFoundError
from tests.tasks import MEASURED, make, skip_without_data


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
    tilt = -0.05 * torch.linspace(-1.0, 0.98, 100)
    for found in simulator(theta.repeat(3, 1)).double():
        assert float(found.mean()) == pytest.approx(0.0, abs=1e-5)
        assert float(found.square().mean()) == pytest.approx(1.0, abs=1e-5)
        # The path is the only unknown: a combination of mixture, tilt and constant.
        design = torch.stack([mixed, tilt.double(), torch.ones(100).double()], dim=1)
        solution = torch.linalg.lstsq(design, found[:, None]).solution[:, 0]
        assert torch.allclose(design @ solution, found, atol=1e-4)
        assert 1.5 <= float(solution[0] / solution[1]) <= 6.0
    # Water absorbs most at 975 nm, and fat has a band at 930 nm.
    assert spectra().argmax(dim=1)[:2].tolist() == [62, 40]


def test_measured_data_are_named_where_they_are_missing(tmp_path: Path) -> None:
    for name in MEASURED:
        with pytest.raises(DataNotFoundError, match=r"Get it from http"):
            get_task(name, root=tmp_path).get_test_set(3)


def test_no_cruise_and_no_sample_is_in_both_sets() -> None:
    for name, variant in (("near_infrared", None), ("ocean_colour", "other_cruises")):
        task = make(name, variant=variant)
        skip_without_data(task)
        rows = {
            part: set(task._real_process(part).rows_of(part))
            for part in ("calibration", "test")
        }
        groups = task._real_process("test").groups
        of_part = [{groups[row] for row in rows[part]} for part in rows]
        assert not of_part[0] & of_part[1]
        assert len(set(groups)) == len(of_part[0]) + len(of_part[1])
        # The folder of a folder is searched as well.
        root = None if task.root is None else task.root.parent
        assert get_task(name, root=root).has_data
