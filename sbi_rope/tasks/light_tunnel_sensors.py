r"""Readings of the light tunnel's sensors, by a published law and as recorded."""

from dataclasses import dataclass
from pathlib import Path

import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Tensor, nn

from sbi_rope.npe.prior import check_in_support
from sbi_rope.tasks.base import Task
from sbi_rope.tasks.chambers import find_file, read_columns
from sbi_rope.tasks.distributions import UniformDistance, box
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.splits import Part, RecordedPairs
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import NotNegative, Settings, check
from sbi_rope.utils.tensors import as_batch

DATASET = "lt_interventions_standard_v1"
INPUTS = ("red", "green", "blue", "pol_1", "pol_2")
OUTPUTS = ("ir_1", "vis_1", "ir_2", "vis_2", "ir_3", "vis_3", "current")

# Constants of the law, as published with the package causalchamber.
RESPONSE = (  # rows: infrared, visible; columns: red, green, blue
    (4.34165202, 2.8594438, 1.91565691),
    (0.89410569, 1.58679242, 2.68477163),
)
DISTANCES = (0.1, 0.17, 0.25)  # from the source to the three sensors
FIRST_POLARISER = (0.42685688, 0.41231782, 0.46652526)
ALIGNED = (0.2909342, 0.29624314, 0.30526271)
CROSSED = (0.00431032, 0.01447611, 0.02041075)
CURRENT_RESPONSE = (0.12834946, 0.12870338, 0.13078523)
CURRENT_AT_REST = 58.13307318503893
# Settings of the recorded experiment: photodiode sizes 2 and 1, exposure time 3 and
# the current's reference voltage 5 V, at which it has no factor.
GAIN = (2.0 ** (2 + 3), 2.0 ** (1 + 3))  # infrared, visible

REFERENCE = "uniform_reference"
# Experiments whose colours, angles or sensor settings are not those of the reference.
STRONG_COLOURS = tuple(f"uniform_{c}_strong" for c in ("red", "green", "blue"))
STRONG_ANGLES = ("uniform_pol_1_strong", "uniform_pol_2_strong")
SETTINGS = tuple(
    f"uniform_{setting}_strong"
    for setting in (
        *(f"t_{diode}_{sensor}" for sensor in (1, 2, 3) for diode in ("ir", "vis")),
        "v_c",
    )
)
# The experiments of the variants that choose their own, calibration and test.
OWN_EXPERIMENTS = {
    "strong_colours": (STRONG_COLOURS, STRONG_COLOURS),
    "strong_angles": (STRONG_ANGLES, STRONG_ANGLES),
    "sensor_settings": ((REFERENCE,), SETTINGS),
}


@dataclass(frozen=True, kw_only=True)
class LightTunnelSimulator(Settings):
    r"""Six light readings and a current, after the published law with noise.

    With :math:`c` the colours of the source, :math:`S` the response of the two
    photodiodes times their gain, :math:`d_i` the distances, :math:`T` transmissions
    of the polarisers and :math:`\Delta` the angle between them, sensor :math:`i`
    reads

    .. math::
        r_1 = S c, \quad
        r_2 = \tfrac{d_1^2}{d_2^2} S (T_s \odot c), \quad
        r_3 = \tfrac{d_1^2}{d_3^2} S (T(\Delta) \odot c), \quad
        T(\Delta) = T_c + (T_p - T_c) \cos^2 \Delta,

    and the light source draws :math:`q^\top c + C_0`. Noise is relative on the six
    readings, which are then cut off at 0, and additive on the current. Readings are
    returned as :math:`\log(r + 1)`.

    References:
        | Sanity Checking Causal Representation Learning on a Simple Real-World System
          (Gamella, Bing and Runge, 2025), appendix C
        | https://github.com/juangamella/causal-chamber-package, simulator
          ``lt.Deterministic`` (MIT licence)

    Args:
        relative_noise: Standard deviation of the readings, as a fraction of them.
        current_noise_std: Standard deviation of the current, in its raw units.

    Example:
        >>> law = LightTunnelSimulator().readings(torch.tensor([[80.0, 0, 0, 0]]))
        >>> law.round()[0, :2]
        tensor([11115.,  1144.])
    """

    relative_noise: NotNegative = 0.03
    current_noise_std: NotNegative = 4.0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 4)``, to shape ``(n, 7)``."""
        readings = self.readings(as_batch("theta", theta, (4,), empty=True))
        light, current = readings[:, :6], readings[:, 6:]
        light = light * (1 + self.relative_noise * torch.randn_like(light))
        current = current + self.current_noise_std * torch.randn_like(current)
        # Colours below 0, which the prior allows down to -0.5, read less than 0.
        return torch.cat([light.clamp(min=0.0).log1p(), current], dim=1)

    def readings(self, theta: Tensor) -> Tensor:
        """Return raw readings ``(n, 7)`` without noise, differentiable in ``theta``."""
        colour, angle = theta[:, :3], theta[:, 3:]
        response = theta.new_tensor(RESPONSE).T * theta.new_tensor(GAIN)
        aligned, crossed = theta.new_tensor(ALIGNED), theta.new_tensor(CROSSED)
        malus = torch.cos(torch.deg2rad(angle)) ** 2
        near, middle, far = DISTANCES
        transmissions = (
            torch.ones_like(crossed),
            (near / middle) ** 2 * theta.new_tensor(FIRST_POLARISER),
            (near / far) ** 2 * (crossed + (aligned - crossed) * malus),
        )
        light = [(transmission * colour) @ response for transmission in transmissions]
        weights = theta.new_tensor(CURRENT_RESPONSE).unsqueeze(1)
        return torch.cat([*light, colour @ weights + CURRENT_AT_REST], dim=1)


class LightTunnelSensors(Task):
    r"""Colours and polariser angle of a light tunnel, from measured sensor readings.

    The observations are real: a light source shines through two polarisers onto three
    light sensors, each with an infrared and a visible-light diode. The parameters are
    the red, green and blue settings of the source and the absolute angle between the
    polarisers (the law knows no other property of the two positions). The simulator
    (:class:`LightTunnelSimulator`) over-predicts the measured light by 23 % to 34 %,
    and knows nothing of six small lamps beside the sensors that change during the
    experiment.

    The prior follows the experiment's protocol: colours are uniform integers from 0 to
    85, hence uniform on [-0.5, 85.5] here, and each polariser has independent uniform
    positions on a range of 40 degrees, hence
    :class:`~sbi_rope.tasks.distributions.UniformDistance`. The recorded angles are 5 %
    smaller on average (12.7 instead of 13.3 degrees), so that this prior, too, is only
    nearly right.

    An observation is :math:`\log(r + 1)` of ``ir_1, vis_1, ir_2, vis_2, ir_3, vis_3``,
    and the raw ``current``. A fixed third of the recorded rows (2000 of 6000) is for
    calibration, the rest for tests.

    References:
        | https://github.com/juangamella/causal-chamber, data set
          ``lt_interventions_standard_v1`` (CC BY 4.0)

    Three variants use other experiments of the data set. In ``"strong_angles"`` the
    light does not tell an angle from its supplement, so that posteriors have two modes.
    In ``"sensor_settings"`` the calibration set is the standard one, but the test set
    pools seven experiments with another exposure time of one diode (``t_*``) or another
    reference voltage of the current (``v_c``) that the simulator knows nothing of.

    Args:
        variant, label_noise: See :class:`~sbi_rope.tasks.Task`.
        root: Folder that holds ``lt_interventions_standard_v1/``. Only the two data
            sets need it.
        download: Whether to download the data set into ``root`` if it is not there.
        experiment: The recorded experiment that both sets come from,
            ``"uniform_reference"`` unless given; not for the variants that choose it
            themselves. Others of the data set change a lamp (``uniform_l_11_mid``) or a
            sensor's setting (``uniform_t_ir_1_strong``) and so misspecify the simulator
            in another way; those with parameters outside of the prior are refused. A
            recording of one's own may have any number of rows.
    """

    name = "light_tunnel_sensors"
    parameter_names = ("red", "green", "blue", "polariser_angle")
    parameter_units = ("1", "1", "1", "degree")
    x_shape = (len(OUTPUTS),)
    x_names = (*(f"log_{output}" for output in OUTPUTS[:6]), "current")
    misspecification = (
        "the published law over-predicts the light by a quarter to a third, and six "
        "lamps beside the sensors change unknown to it"
    )
    variants = COMMON_VARIANTS | {
        "strong_colours": "one colour of the source is from 171 to 255, with a prior "
        "widened to 255.5",
        "strong_angles": "one polariser is turned away by 42 to 118 degrees, with a "
        "prior widened to [0, 120]",
        "sensor_settings": "test observations have another exposure time at one diode, "
        "or another reference voltage of the current",
    }
    shifted_region = {"red": (45.0, 85.5), "polariser_angle": (0.0, 15.0)}  # noqa: RUF012

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        download: bool = False,
        experiment: str | None = None,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        check("experiment", experiment, str | None)
        if experiment is not None and variant in OWN_EXPERIMENTS:
            raise InvalidInputError(
                f"Expected no `experiment` with `variant={variant!r}`, which has its "
                f"own; got {experiment!r}."
            )
        self.download = download
        self.experiment = REFERENCE if experiment is None else experiment

    def get_prior(self) -> MultipleIndependent:
        """Return the prior: uniform colours, and the distance of two angles.

        As with every ``MultipleIndependent`` of sbi, a sample shape of more than one
        dimension is flattened, and ``log_prob`` takes at most two dimensions.
        """
        # Its constructor draws a sample to learn the shapes.
        with torch.random.fork_rng(devices=[]):
            return MultipleIndependent([self._colour_prior(), self._angle_prior()])

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        """Return the distribution functions of colours and angle, ``(n, 4)``."""
        colours = self._colour_prior().base_dist.cdf(theta[:, :3])
        prior = self._angle_prior()
        angle = prior if isinstance(prior, UniformDistance) else prior.base_dist
        return torch.cat([colours, angle.cdf(theta[:, 3:])], dim=1)

    def _colour_prior(self) -> BoxUniform:
        high = 255.5 if self.variant == "strong_colours" else 85.5
        return box((-0.5,) * 3, (high,) * 3)

    def _angle_prior(self) -> UniformDistance | BoxUniform:
        if self.variant == "strong_angles":
            return box((0.0,), (120.0,))
        return UniformDistance(torch.tensor([40.0], dtype=torch.float32))

    def get_simulator(self) -> LightTunnelSimulator:
        """Return the published law with noise."""
        return LightTunnelSimulator()

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return a network with three hidden layers of 64 and eight outputs."""
        return fully_connected(len(OUTPUTS), (64, 64, 64, 8))

    def _recorded_files(self) -> tuple[Path, ...]:
        experiments = dict.fromkeys(
            (*self._experiments("calibration"), *self._experiments("test"))
        )
        return tuple(Path(DATASET, f"{name}.csv") for name in experiments)

    def _experiments(self, part: Part) -> tuple[str, ...]:
        standard = (self.experiment,)
        pair = OWN_EXPERIMENTS.get(self.variant or "", (standard, standard))
        return pair[part == "test"]

    def _real_process(self, part: Part) -> RecordedPairs:
        recorded = [self._recorded(name) for name in self._experiments(part)]
        theta, x = (torch.cat(parts) for parts in zip(*recorded, strict=True))
        return RecordedPairs(theta=theta.float(), read_x=x.float().__getitem__)

    def _recorded(self, experiment: str) -> tuple[Tensor, Tensor]:
        file = Path(DATASET, f"{experiment}.csv")
        path = find_file(file, root=self.root, download=self.download)
        values = read_columns(path, INPUTS + OUTPUTS)
        colour, positions, readings = values.split([3, 2, len(OUTPUTS)], dim=1)
        angle = (positions[:, :1] - positions[:, 1:]).abs()
        theta = torch.cat([colour, angle], dim=1)
        check_in_support(f"theta of {file}", theta.float(), self.get_prior())
        x = torch.cat([readings[:, :6].log1p(), readings[:, 6:]], dim=1)
        return theta, as_batch(f"logarithms of {path}", x)
