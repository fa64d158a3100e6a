r"""Chlorophyll and coloured matter in the sea, from its colour."""

from dataclasses import dataclass
from pathlib import Path

import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.chambers import find_file, numbers_of, read_table
from sbi_rope.tasks.distributions import box
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.splits import Part, RecordedPairs
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.utils.settings import NotNegative, Settings
from sbi_rope.utils.tensors import as_batch

FILE = Path("ocean", "nomad.csv")
SOURCE = "https://doi.org/10.1016/j.rse.2005.07.001"
BANDS = (411.0, 443.0, 489.0, 510.0, 555.0)  # nm
WATER_ABSORPTION = (0.0045, 0.0071, 0.0148, 0.0325, 0.0596)  # 1/m
ALGAE_ABSORPTION = (0.837, 0.983, 0.755, 0.618, 0.325)  # relative
# Quadratic law of the reflectance below the surface, and what passes the surface.
LINEAR, QUADRATIC = 0.0895, 0.1247
THROUGH, REFLECTED = 0.52, 1.7


@dataclass(frozen=True, kw_only=True)
class OceanColourSimulator(Settings):
    r"""Logarithms of five reflectances of the sea, after textbook laws of ocean optics.

    With the chlorophyll c and the absorption g of coloured matter at 443 nm, water,
    algae and coloured matter absorb a, and water and particles scatter b back:

    .. math::
        a &= a_w + 0.06\, c^{0.65} e_1 s_\lambda + g\, e^{-S (\lambda - 443)}, \\
        b &= 0.00144\, (\lambda / 500)^{-4.32} + 0.416\, c^{0.766} e_2
            \bigl(0.002 + 0.01\, (\tfrac12 - \tfrac14 \log_{10} c)_+
            (\lambda / 550)^v\bigr), \\
        r &= 0.0895\, u + 0.1247\, u^2, \quad u = \frac{b}{a + b}, \qquad
        R = \frac{0.52\, r}{1 - 1.7\, r},

    with :math:`v = \frac12 (\log_{10} c - 0.3)` between -1 and 0 (0 above 2 mg/m³),
    :math:`S \sim \mathcal N(0.015, 0.002)`, and lognormal scatter :math:`e_1, e_2`.

    References:
        | A Semianalytic Radiance Model of Ocean Color (Gordon et al., 1988)
        | Deriving Inherent Optical Properties from Water Color (Lee et al., 2002)

    Args:
        scatter: Standard deviation of the logarithms of :math:`e_1` and :math:`e_2`, to
            base 10.
        relative_noise: Standard deviation of the reflectances, as a fraction of them.

    Example:
        >>> OceanColourSimulator()(torch.tensor([[0.0, -1.0]])).shape
        torch.Size([1, 5])
    """

    scatter: NotNegative = 0.15
    relative_noise: NotNegative = 0.05

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 2)``, to shape ``(n, 5)``."""
        theta = as_batch("theta", theta, (2,), empty=True)
        log_c, log_g = theta[:, :1], theta[:, 1:]
        bands, c = theta.new_tensor(BANDS), 10**log_c
        algae, particles = 10 ** (self.scatter * c.new_empty(2, *c.shape).normal_())
        slope = 0.015 + 0.002 * c.new_empty(c.shape).normal_()
        absorption = (
            theta.new_tensor(WATER_ABSORPTION)
            + 0.06 * c**0.65 * algae * theta.new_tensor(ALGAE_ABSORPTION)
            + 10**log_g * torch.exp(-slope * (bands - 443))
        )
        power = torch.where(c < 2, (0.5 * (log_c - 0.3)).clamp(-1, 0), 0.0)
        share = 0.01 * (0.5 - 0.25 * log_c).clamp(min=0)
        share = 0.002 + share * (bands / 550) ** power
        scattering = (
            0.00144 * (bands / 500) ** -4.32 + 0.416 * c**0.766 * particles * share
        )
        u = scattering / (absorption + scattering)
        below = LINEAR * u + QUADRATIC * u.square()
        reflectance = THROUGH * below / (1 - REFLECTED * below)
        noise = 1 + self.relative_noise * torch.randn_like(reflectance)
        return (reflectance * noise.clamp(min=0.1)).log10()


class OceanColour(Task):
    r"""Chlorophyll and coloured matter of the sea, measured at 666 stations.

    The parameters are :math:`\log_{10}` of chlorophyll in mg/m³, uniform on [-2, 2],
    and of the absorption by coloured matter at 443 nm in 1/m, uniform on [-3, 0.5]. An
    observation is :math:`\log_{10}` of the reflectance of the sea in five bands. The
    simulator (:class:`OceanColourSimulator`) is too dark by a factor of two in the
    blue, and real parameters do not follow its prior.

    A third of the stations is for calibration, the rest for tests. Stations of one
    cruise are alike. In the variant ``"other_cruises"`` no cruise is in both sets.

    References:
        | An Improved In-Situ Bio-Optical Data Set for Ocean Color Algorithm Development
          (Werdell and Bailey, 2005), NASA's NOMAD
        | https://doi.org/10.1016/j.rse.2005.07.001

    Args:
        variant, label_noise: See :class:`~sbi_rope.tasks.Task`.
        root: Folder that holds ``ocean/nomad.csv``, with the columns cruise, chl,
            adg443, and rrs411 to rrs555. Only the two data sets need it.
    """

    name = "ocean_colour"
    parameter_names = ("log_chlorophyll", "log_coloured_matter")
    parameter_units = ("1", "1")
    x_shape = (len(BANDS),)
    x_names = tuple(f"log_rrs_{band:.0f}" for band in BANDS)
    misspecification = (
        "textbook optics are too dark by a factor of two in the blue, and real "
        "parameters do not follow the prior"
    )
    variants = COMMON_VARIANTS | {
        "other_cruises": "no cruise is in both the calibration and the test set",
    }
    shifted_region = {"log_chlorophyll": (-2.0, 0.0)}  # noqa: RUF012

    def get_prior(self) -> BoxUniform:
        """Return the uniform prior."""
        return box((-2.0, -3.0), (2.0, 0.5))

    def get_simulator(self) -> OceanColourSimulator:
        """Return the textbook laws."""
        return OceanColourSimulator()

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return a network with three hidden layers of 64 and eight outputs."""
        return fully_connected(len(BANDS), (64, 64, 64, 8))

    def _recorded_files(self) -> tuple[Path, ...]:
        return (FILE,)

    def _real_process(self, part: Part) -> RecordedPairs:
        path = find_file(FILE, root=self.root, source=SOURCE)
        columns = ["chl", "adg443", *(f"rrs{band:.0f}" for band in BANDS)]
        table = read_table(path, ["cruise", *columns]).drop_duplicates()
        theta, x = (
            numbers_of(table[columns], str(path)).log10().float().split([2, 5], 1)
        )
        groups = table["cruise"].tolist() if self.variant == "other_cruises" else None
        return RecordedPairs(theta=theta, read_x=x.__getitem__, groups=groups)
