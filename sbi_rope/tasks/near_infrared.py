r"""Water, fat and protein of meat, from its absorption of near-infrared light."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.chambers import find_file, numbers_of, read_table
from sbi_rope.tasks.distributions import box
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.splits import Part, RecordedPairs
from sbi_rope.utils.settings import NotNegative, Settings
from sbi_rope.utils.tensors import as_batch

FILE = Path("tecator", "tecator.csv")
SOURCE = "http://lib.stat.cmu.edu/datasets/tecator"
WAVELENGTHS = tuple(range(850, 1050, 2))  # nm
# Absorption of pure water in 1/cm, every 25 nm from 850 on.
WATER = (0.043, 0.056, 0.068, 0.144, 0.388, 0.449, 0.363, 0.22, 0.15)
# Bands of fat and protein: centre in nm, height in 1/cm, width at half height in nm.
FAT = (930.0, 0.12, 35.0), (1040.0, 0.05, 60.0)
PROTEIN = (910.0, 0.08, 50.0), (1020.0, 0.05, 50.0)
FAT_EVERYWHERE = 0.01
PATHS = (1.5, 6.0)  # cm
# The share for calibration: 150 of 193 samples.
SHARE = 0.78


@cache
def spectra() -> Tensor:
    """Return the absorption of water, fat and protein in 1/cm, ``(3, 100)``."""
    at = np.array(WAVELENGTHS, dtype=float)

    def bands(some: tuple[tuple[float, float, float], ...]) -> np.ndarray:
        centre, height, width = np.array(some).T[..., None]
        each = height * np.exp(-4 * np.log(2) * ((at - centre) / width) ** 2)
        return each.sum(axis=0)

    water = np.interp(at, 850 + 25 * np.arange(len(WATER)), WATER)
    return torch.from_numpy(
        np.stack([water, FAT_EVERYWHERE + bands(FAT), bands(PROTEIN)])
    )


def standardised(spectrum: Tensor) -> Tensor:
    """Subtract the mean of each spectrum, and divide by its standard deviation."""
    centred = spectrum - spectrum.mean(dim=1, keepdim=True)
    return centred / centred.square().mean(dim=1, keepdim=True).sqrt()


@dataclass(frozen=True, kw_only=True)
class NearInfraredSimulator(Settings):
    r"""Absorption of a mixture at 100 wavelengths, after the law of Beer and Lambert.

    .. math::
        A(\lambda) = \frac{L}{\ln 10} \sum_k \frac{\theta_k}{100}\, s_k(\lambda)
        + \beta\, \frac{\lambda - 950\,\mathrm{nm}}{100\,\mathrm{nm}} + \varepsilon,

    with the shares :math:`\theta` of water, fat and protein in percent, a light path L
    between 1.5 and 6 cm, and a slope :math:`\beta` that stands in for the scattering. A
    spectrum is returned without its mean, in its own standard deviations.

    Args:
        slope_std: Standard deviation of the slope, whose mean is -0.05.
        noise_std: Standard deviation of :math:`\varepsilon`.

    Example:
        >>> NearInfraredSimulator()(torch.tensor([[60.0, 20.0, 18.0]])).shape
        torch.Size([1, 100])
    """

    slope_std: NotNegative = 0.1
    noise_std: NotNegative = 0.001

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 3)``, to shape ``(n, 100)``."""
        theta = as_batch("theta", theta, (3,), empty=True)
        low, high = PATHS
        path = low + (high - low) * theta.new_empty(len(theta), 1).uniform_()
        slope = -0.05 + self.slope_std * theta.new_empty(len(theta), 1).normal_()
        absorption = path * (theta / 100) @ spectra().to(theta) / np.log(10)
        tilt = (theta.new_tensor(WAVELENGTHS) - 950) / 100
        noise = self.noise_std * torch.randn_like(absorption)
        return standardised(absorption + slope * tilt + noise)


class NearInfrared(Task):
    r"""Water, fat and protein of 193 samples of meat, from their absorption spectra.

    The parameters are shares in percent: water uniform on [35, 80], fat on [0, 55] and
    protein on [8, 25]. An observation is the absorption at 850, 852, ..., 1048 nm,
    without its mean and in its standard deviations. The simulator
    (:class:`NearInfraredSimulator`) mixes textbook spectra of the three and knows
    nothing of scattering. Real samples follow nothing like its prior: water, fat and
    protein nearly add up to 100 %.

    150 samples are for calibration, the rest for tests. Rows that the file holds twice
    are left out, and different spectra with equal labels are in the same set.

    References:
        | Tecator data (Thodberg, 1996), StatLib
        | http://lib.stat.cmu.edu/datasets/tecator

    Args:
        variant, label_noise: See :class:`~sbi_rope.tasks.Task`.
        root: Folder that holds ``tecator/tecator.csv``, with the columns water, fat,
            protein, and a850 to a1048. Only the two data sets need it.
    """

    name = "near_infrared"
    parameter_names = ("water", "fat", "protein")
    parameter_units = ("%", "%", "%")
    x_shape = (len(WAVELENGTHS),)
    misspecification = (
        "light is scattered and the spectra of water, fat and protein are rough, and "
        "real parameters do not follow the prior"
    )
    shifted_region = {"fat": (0.0, 15.0)}  # noqa: RUF012

    def get_prior(self) -> BoxUniform:
        """Return the uniform prior."""
        return box((35.0, 0.0, 8.0), (80.0, 55.0, 25.0))

    def get_simulator(self) -> NearInfraredSimulator:
        """Return the law of Beer and Lambert with textbook spectra."""
        return NearInfraredSimulator()

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return a network with three hidden layers of 64 and ten outputs."""
        return fully_connected(len(WAVELENGTHS), (64, 64, 64, 10))

    def _recorded_files(self) -> tuple[Path, ...]:
        return (FILE,)

    def _real_process(self, part: Part) -> RecordedPairs:
        path = find_file(FILE, root=self.root, source=SOURCE)
        columns = ["water", "fat", "protein", *(f"a{at}" for at in WAVELENGTHS)]
        values = numbers_of(read_table(path, columns).drop_duplicates(), str(path))
        theta, x = values[:, :3].float(), standardised(values[:, 3:]).float()
        groups = [tuple(row) for row in theta.tolist()]
        return RecordedPairs(
            theta=theta, read_x=x.__getitem__, groups=groups, share=SHARE
        )
