r"""Task F: the position of a hatch, from the pressure after an impulse of a fan."""

from dataclasses import replace
from pathlib import Path

import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope.npe.prior import check_in_support
from sbi_rope.tasks.base import Task
from sbi_rope.tasks.chambers import find_file, read_columns
from sbi_rope.tasks.distributions import box
from sbi_rope.tasks.networks import SeriesEmbedding, light_series_embedding
from sbi_rope.tasks.settings import PaperSettings
from sbi_rope.tasks.splits import DrawnPairs, Part, RecordedPairs
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.tasks.wind_tunnel_model import (
    INERTIA,
    MAX_HATCH,
    MAX_PRESSURE,
    NUM_STEPS,
    WindTunnelSimulator,
)
from sbi_rope.utils.tensors import as_batch

DATASET = "wt_intake_impulse_v1"
EXPERIMENT = "load_out_0.5_osr_downwind_4"
COLUMNS = ("flag", "hatch", "pressure_downwind", "pressure_ambient")

# How the stand-in for the recorded data differs from the simulator.
WEAKER_FANS = 0.05  # of the pressure they make
HEAVIER_FANS = 0.1  # of their moment of inertia
FASTER_EXHAUST = 5.0  # rad/s
NOISE_CORRELATION = 0.6


class WindTunnel(Task):
    r"""Task F of the paper: the hatch of a wind tunnel from a curve of pressure.

    The parameter is the position :math:`H` of a hatch in the wall of a tunnel with a
    fan at each end, with prior :math:`\mathcal{U}[0, 45]` degrees. An observation is
    the pressure inside minus the ambient pressure, at 50 times around an impulse of
    the intake fan. The simulator (``WindTunnelSimulator``) knows neither the
    inertia of the air nor turbulence, and reduces the fans to a straight line between
    pressure and flow.

    The observations are recorded: 5000 impulses with the hatch at random, a fixed
    third of which is for calibration. Without them, the variant ``"synthetic"``, or
    any other with ``stand_in=True``, draws from a stand-in: the same model with fans
    that make 5 % less pressure and have 10 % more inertia, an exhaust fan that turns
    5 rad/s (3 to 5 %) faster than the simulator believes, and noise with correlation
    0.6 between neighbouring samples. To the simulator this looks like a hatch open by
    four (near 45) to eleven (near 0) degrees more, where its posterior has a standard
    deviation of 0.4.
    A stand-in shows that a method runs. Its scores say nothing about the real tunnel.

    References:
        | https://github.com/juangamella/causal-chamber, data set
          ``wt_intake_impulse_v1`` (CC BY 4.0)

    Args:
        variant, label_noise: See :class:`~sbi_rope.tasks.Task`.
        root: Folder that holds ``wt_intake_impulse_v1/``. Only the two recorded sets
            need it.
        download: Whether to download the data set into ``root`` if it is not there.
        stand_in: Whether to draw real observations from the stand-in instead of reading
            them; always so in the variant ``"synthetic"``. It goes with every variant,
            as ``root`` does, so that all can be run without data.
        onset_jitter: Largest shift of the impulse, in s, from 0 to 0.6, simulated
            and in the stand-in.

    Example:
        >>> theta, x_o = WindTunnel(variant="synthetic").get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 1]), torch.Size([50, 50]))
    """

    name = "wind_tunnel"
    parameter_names = ("hatch",)
    parameter_units = ("degree",)
    x_shape = (NUM_STEPS,)
    misspecification = (
        "the air has no inertia and no turbulence, and a fan is a straight line "
        "between pressure and flow"
    )
    variants = COMMON_VARIANTS | {
        "synthetic": "the real process is a stand-in that needs no recorded data: "
        "weaker, heavier fans and correlated noise",
    }
    shifted_region = {"hatch": (22.5, MAX_HATCH)}  # noqa: RUF012
    paper_settings = PaperSettings(finetuning_steps=20_000, joint_epoch_size=10_000)

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        download: bool = False,
        stand_in: bool = False,
        onset_jitter: float = 0.3,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        self.stand_in = stand_in or variant == "synthetic"
        self.download = download
        self.onset_jitter = onset_jitter
        self._stand_in = WindTunnelSimulator(
            onset_jitter=onset_jitter,
            noise_correlation=NOISE_CORRELATION,
            max_pressure=(1 - WEAKER_FANS) * MAX_PRESSURE,
            inertia=(1 + HEAVIER_FANS) * INERTIA,
            exhaust_offset=FASTER_EXHAUST,
        )

    def get_prior(self) -> BoxUniform:
        """Return the uniform prior on [0, 45] degrees, whose density is 1 / 45."""
        return box((0.0,), (MAX_HATCH,), closed=True)

    def get_simulator(self) -> WindTunnelSimulator:
        """Return the published model with noise and an impulse at a random time."""
        return WindTunnelSimulator(onset_jitter=self.onset_jitter)

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return the convolutional network of task C or a light one, of ten outputs."""
        if light:
            return light_series_embedding(num_steps=NUM_STEPS, output_dim=10)
        return SeriesEmbedding(num_steps=NUM_STEPS, output_dim=10, padding=2)

    def _recorded_files(self) -> tuple[Path, ...]:
        return () if self.stand_in else (Path(DATASET, f"{EXPERIMENT}.csv"),)

    def _real_process(self, part: Part) -> DrawnPairs | RecordedPairs:
        if not self.stand_in:
            theta, x = self._recorded()
            return RecordedPairs(theta=theta, read_x=x.__getitem__)
        return replace(self._simulated_process(), observe=self._stand_in)

    def _recorded(self) -> tuple[Tensor, Tensor]:
        (file,) = self._recorded_files()
        path = find_file(file, root=self.root, download=self.download)
        flag, hatch, inside, ambient = read_columns(path, COLUMNS).T
        # An impulse that a recording begins or ends in has fewer samples.
        _, counts = flag.unique_consecutive(return_counts=True)
        first = (counts.cumsum(0) - counts)[counts == NUM_STEPS]
        # Both are near 95 000 Pa, where float32 has steps of 0.008: subtract first.
        x = (inside - ambient)[first[:, None] + torch.arange(NUM_STEPS)].float()
        theta = hatch[first, None].float()
        check_in_support(f"theta of {file}", theta, self.get_prior())
        return theta, as_batch(f"impulses of {NUM_STEPS} rows in {path}", x)
