r"""Task E: images of a light tunnel, for which the simulator paints hexagons."""

from functools import partial
from pathlib import Path

import torch
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Tensor

from sbi_rope.npe.prior import check_in_support
from sbi_rope.tasks.base import Task
from sbi_rope.tasks.chambers import (
    find_file,
    read_columns,
    read_images,
    read_table,
)
from sbi_rope.tasks.distributions import Arcsine, box
from sbi_rope.tasks.light_tunnel_models import (
    MAX_LEVEL,
    CameraSimulator,
    HexagonSimulator,
    as_brightness,
    draw_crowded,
    malus,
)
from sbi_rope.tasks.networks import ImageEmbedding
from sbi_rope.tasks.settings import PaperSettings
from sbi_rope.tasks.splits import DrawnPairs, Keep, Part, RecordedPairs, generator_of
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.utils.settings import check, one_of

DATASET = "lt_camera_v1"
INPUTS = ("red", "green", "blue", "pol_1", "pol_2")
IMAGE_SIZES = (64, 100)
UNIFORM = "uniform_ap_1.8_iso_500.0_ss_0.005"
BETA_BINOMIAL = "betab_ap_1.8_iso_500.0_ss_0.005"
# The experiments of the variants that choose their own, calibration and test.
OWN_EXPERIMENTS = {
    "misspecified_prior": (BETA_BINOMIAL, BETA_BINOMIAL),
    "biased_calibration": (BETA_BINOMIAL, UNIFORM),
}


class LightTunnel(Task):
    r"""Task E of the paper: colours and polarisers of a light tunnel, from images.

    A camera looks through two polarisers at a light source. The parameters are the
    source's red, green and blue settings, and the share of light
    :math:`\alpha = \cos^2(\varphi_1 - \varphi_2)` that the angles of the polarisers
    let through (Malus' law). The simulator (``HexagonSimulator``, model F1)
    paints a hexagon in the colour :math:`\alpha (R, G, B)`: it knows nothing of the
    background, the response of the camera, over-exposure, or of polarisers that
    treat colours differently and let light through when crossed.

    The prior is that of the experiment: colours uniform on [0, 255], and uniform
    angles, hence :class:`~sbi_rope.tasks.distributions.Arcsine` for :math:`\alpha`.

    Real images have 8 bit a channel and are divided by 255. A fixed third of the
    10 000 recorded ones is for calibration, the rest for tests. Only those asked for
    are read.

    Most pixels are 0 in every simulation: train NPE with ``z_score_x="none"`` or
    ``"structured"``. sbi's default standardises each pixel, and turns a background
    of 0.1 into a million. sbi lists the constant pixels in a long warning even so,
    unless the images are dequantised.

    In ``"misspecified_prior"`` both sets come from the experiment
    ``betab_ap_1.8_iso_500.0_ss_0.005``, in ``"biased_calibration"`` the calibration set
    alone does, as in the paper. In ``"synthetic"`` model F3 with noise
    (``CameraSimulator``) stands in for the camera, so that no files are needed;
    ``stand_in=True`` does this in any other variant. The hexagon is nearly symmetric,
    so that flipping a stand-in only moves it by one row.

    References:
        | https://github.com/juangamella/causal-chamber, data set ``lt_camera_v1``
          (CC BY 4.0)

    Args:
        variant, label_noise: See :class:`~sbi_rope.tasks.Task`.
        root: Folder that holds ``lt_camera_v1/``. Only the two data sets need it, and
            they do not with a stand-in.
        download: Whether to download the data set into ``root`` if it is not there.
        image_size: Height and width of the images in pixels, 64 or 100. Data sets
            from before version 1.4 have no images of size 64.
        dequantise: Whether to add uniform noise within each 8-bit level, to simulated
            and real images alike.
        stand_in: Whether model F3 replaces the recorded images. Without effect in
            the variants that need no files, so that it can be passed to all.

    Example:
        >>> task = LightTunnel(variant="synthetic", image_size=64)
        >>> theta, x_o = task.get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 4]), torch.Size([50, 3, 64, 64]))
    """

    name = "light_tunnel"
    parameter_names = ("red", "green", "blue", "alpha")
    parameter_units = ("1", "1", "1", "1")
    x_shape = (3, 100, 100)
    z_score_x = "none"
    misspecification = (
        "a plain hexagon stands for the image, without background, the response of "
        "the camera, or polarisers that treat colours differently"
    )
    variants = COMMON_VARIANTS | {
        "biased_calibration": "colours and polariser angles of the calibration set "
        "crowd in the middle of their ranges, those of the test set do not",
        "misspecified_prior": "colours and polariser angles of both sets crowd in the "
        "middle of their ranges",
        "flipped": "test images are flipped vertically, calibration images are not",
        "synthetic": "a more detailed model of the camera stands in for real images",
    }
    shifted_region = {"red": (127.5, 255.0), "alpha": (0.0, 0.5)}  # noqa: RUF012
    paper_settings = PaperSettings(
        conditioner=(500, 500, 500),
        integrand=(150, 150, 150, 150),
        learning_rate=5e-4,
        finetuning_learning_rate=1e-4,
        finetuning_steps=2000,
        joint_epoch_size=1000,
    )

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        download: bool = False,
        image_size: int = 100,
        dequantise: bool = False,
        stand_in: bool = False,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        check("image_size", image_size, one_of(IMAGE_SIZES))
        self.stand_in = stand_in or variant == "synthetic"
        self.image_size = image_size
        self.x_shape = (3, self.image_size, self.image_size)
        self.dequantise = dequantise
        self.download = download

    def get_prior(self) -> MultipleIndependent:
        """Return the prior: uniform colours, and the law of a squared cosine.

        As with every ``MultipleIndependent`` of sbi, a sample shape of more than one
        dimension is flattened, and ``log_prob`` takes at most two dimensions.
        """
        # Its constructor draws a sample to learn the shapes.
        with torch.random.fork_rng(devices=[]):
            return MultipleIndependent([_colour_prior(), _alpha_prior()])

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        """Return the distribution functions of colours and alpha, ``(n, 4)``."""
        colours = _colour_prior().base_dist.cdf(theta[:, :3])
        return torch.cat([colours, _alpha_prior().cdf(theta[:, 3:])], dim=1)

    def get_simulator(self) -> HexagonSimulator:
        """Return model F1."""
        return HexagonSimulator(image_size=self.image_size, dequantise=self.dequantise)

    def get_embedding_net(self, *, light: bool = False) -> ImageEmbedding:
        """Return the paper's convolutional network or a light one, with 20 outputs."""
        return ImageEmbedding(image_size=self.image_size, light=light)

    def _recorded_files(self) -> tuple[Path, ...]:
        if self.stand_in:
            return ()
        experiments = (self._experiment("calibration"), self._experiment("test"))
        return tuple(_table(experiment) for experiment in dict.fromkeys(experiments))

    def _experiment(self, part: Part) -> str:
        pair = OWN_EXPERIMENTS.get(self.variant or "", (UNIFORM, UNIFORM))
        return pair[part == "test"]

    def _keep(self, part: Part) -> Keep | None:
        # A biased set comes from an experiment that is biased already.
        return None if self.variant == "biased_calibration" else super()._keep(part)

    def _real_process(self, part: Part) -> DrawnPairs | RecordedPairs:
        return self._drawn(part) if self.stand_in else self._recorded(part)

    def _drawn(self, part: Part) -> DrawnPairs:
        camera = CameraSimulator(image_size=self.image_size, dequantise=self.dequantise)
        crowded = self._experiment(part) == BETA_BINOMIAL
        process = self._simulated_process()
        return DrawnPairs(
            draw_theta=draw_crowded if crowded else process.draw_theta,
            observe=lambda theta: self._oriented(camera(theta), part),
        )

    def _recorded(self, part: Part) -> RecordedPairs:
        table = _table(self._experiment(part))
        path = find_file(table, root=self.root, download=self.download)
        folder = path.parent / f"images_{self.image_size}"
        colour, angles = read_columns(path, INPUTS).split([3, 2], dim=1)
        theta = torch.cat([colour, malus(angles)], dim=1).float()
        check_in_support(f"theta of {table}", theta, self.get_prior())
        names = read_table(path, ["image_file"])["image_file"].astype(str).tolist()
        return RecordedPairs(
            theta=theta, read_x=partial(self._read_x, folder, names, part)
        )

    def _read_x(
        self, folder: Path, names: list[str], part: Part, rows: list[int]
    ) -> Tensor:
        chosen = [names[row] for row in rows]
        levels = read_images(folder, chosen, self.image_size).float()
        if not self.dequantise:
            return self._oriented(as_brightness(levels, dequantise=False), part)
        for image, name in zip(levels, chosen, strict=True):
            # The same noise on an image whenever it is read.
            noise = generator_of(f"dequantise {folder.parent.name}/{name}")
            image.copy_(as_brightness(image, dequantise=True, generator=noise))
        return self._oriented(levels, part)

    def _oriented(self, x: Tensor, part: Part) -> Tensor:
        """Return images the way up that they have in one part of the variant."""
        return x.flip(-2) if self.variant == "flipped" and part == "test" else x


def _table(experiment: str) -> Path:
    return Path(DATASET, experiment, f"{experiment}.csv")


def _colour_prior() -> BoxUniform:
    return box((0.0,) * 3, (float(MAX_LEVEL),) * 3, closed=True)


def _alpha_prior() -> Arcsine:
    return Arcsine(torch.ones(1, dtype=torch.float32))
