r"""Two published models of the light tunnel's images, one with a camera's noise.

References:
    | Causal chambers as a real-world physical testbed for AI methodology
      (Gamella, Peters and Bühlmann, 2025), appendix on the image models
    | https://doi.org/10.1038/s42256-024-00964-x
    | https://github.com/juangamella/causal-chamber-package, ``models.model_f1`` and
      ``models.model_f3`` (MIT licence)
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Beta, Binomial

from sbi_rope.utils.settings import Count, Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

MAX_LEVEL = 255  # of an 8-bit channel, and of a colour of the source
RADIUS = 0.22  # of the light source, as a share of the image

# Constants of model F3 as published with the package causalchamber, fitted by its
# authors; rows and entries are red, green and blue.
RESPONSE = (
    (0.29958, 0.06920, 0.02816),
    (0.04017, 0.92099, 0.31265),
    (0.00217, 0.20716, 0.75763),
)
WHITE_BALANCE = (2.65625, 1.0, 1.77344)
EXPOSURE = 2.5
ALIGNED = (0.29, 0.35, 0.33)
CROSSED = (0.02, 0.08, 0.18)
CAMERA_NOISE = 2 / MAX_LEVEL


@dataclass(frozen=True, kw_only=True)
class HexagonSimulator(Settings):
    r"""A hexagon in the colour of the source, dimmed by two polarisers (model F1).

    With :math:`M` the pixels of the hexagon, a pixel's red, green and blue are

    .. math:: x = \lfloor \alpha \, (R, G, B) \, M \rfloor / 255.

    The model is deterministic, and an image has only three numbers for the four
    parameters, cut off to 8 bit; where all are below 1 it is black.

    Args:
        image_size: Height and width of an image, in pixels.
        dequantise: Whether to add uniform noise within each 8-bit level, see
            :func:`as_brightness`.

    Example:
        >>> x = HexagonSimulator()(torch.tensor([[200.0, 100.0, 0.0, 0.5]]))
        >>> x.shape
        torch.Size([1, 3, 100, 100])
        >>> 255 * x[0, :, 50, 50]
        tensor([100.,  50.,   0.])
    """

    image_size: Count = 100
    dequantise: bool = False

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 4)``, to ``(n, 3, size, size)``."""
        theta = as_batch("theta", theta, (4,), empty=True)
        levels = (theta[:, 3:] * theta[:, :3]).floor()
        # As they are floored before, a masked pixel is a product with 0 or 1.
        if self.dequantise:
            return as_brightness(_masked(levels, self.image_size), dequantise=True)
        return _masked(levels / MAX_LEVEL, self.image_size)


@dataclass(frozen=True, kw_only=True)
class CameraSimulator(Settings):
    r"""The hexagon as a camera sees it (model F3), with noise and in 8 bit.

    With :math:`W S` the response of the camera to the colours, :math:`e` its
    exposure, and :math:`T_p, T_c` the light that parallel and crossed polarisers let
    through at each colour, the image before the noise is

    .. math:: \min\left( 1, \; e \, W S \, (R, G, B) / 255
        \odot ((T_p - T_c) \, \alpha + T_c) \right) M.

    The published model ends here. Noise and rounding are additions of ours.

    Args:
        image_size: Height and width of an image, in pixels.
        dequantise: Whether to add uniform noise within each 8-bit level, see
            :func:`as_brightness`.
        sensor_noise: Standard deviation of Gaussian noise on every pixel and channel,
            as a share of full brightness; may be 0.

    Example:
        >>> white = torch.tensor([[255.0, 255.0, 255.0, 1.0]])
        >>> CameraSimulator().image(white)[0, :, 50, 50]
        tensor([0.7644, 1.0000, 1.0000])
    """

    image_size: Count = 100
    dequantise: bool = False
    sensor_noise: UnitInterval = CAMERA_NOISE

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 4)``, to ``(n, 3, size, size)``."""
        image = self.image(as_batch("theta", theta, (4,), empty=True))
        noisy = image + self.sensor_noise * torch.randn_like(image)
        levels = (MAX_LEVEL * noisy).round().clamp(0, MAX_LEVEL)
        return as_brightness(levels, dequantise=self.dequantise)

    def image(self, theta: Tensor) -> Tensor:
        """Return images ``(n, 3, size, size)`` in [0, 1] without noise."""
        colour, alpha = theta[:, :3] / MAX_LEVEL, theta[:, 3:]
        aligned, crossed = theta.new_tensor(ALIGNED), theta.new_tensor(CROSSED)
        response = theta.new_tensor(RESPONSE).T * theta.new_tensor(WHITE_BALANCE)
        light = EXPOSURE * (colour @ response)
        light = light * ((aligned - crossed) * alpha + crossed)
        return _masked(light.clamp(max=1.0), self.image_size)


def hexagon_mask(image_size: int, *, like: Tensor | None = None) -> Tensor:
    r"""Return 1 at the pixels inside of the light source, else 0.

    With :math:`r` the radius and :math:`u, v` the column and row of a pixel, counted
    from the middle of the image, the inside is

    .. math:: |u| + |v| / \sqrt{3} < r, \qquad |v| < \sqrt{3} r / 2.

    Rows are counted from below, so that the middle is ``image_size / 2`` rows above
    the last one. In causalchamber's mask, which this one equals, rounding leaves
    pixels on the border outside.

    It has the dtype and device of a tensor, or is float64 on the CPU.

    Example:
        >>> hexagon_mask(100).sum()
        tensor(1277., dtype=torch.float64)
    """
    pixels = torch.arange(image_size, dtype=torch.float64, device="cpu")
    from_middle = pixels - image_size / 2
    u, v = from_middle.abs(), from_middle.flip(0).abs().unsqueeze(1)
    # The two outermost corners are pixels at some sizes: outside, despite rounding.
    radius = RADIUS * image_size - 1e-9
    inside = (u + v / 3**0.5 < radius) & (v < radius * 0.75**0.5)
    return inside.double() if like is None else inside.to(like)


def as_brightness(
    levels: Tensor, *, dequantise: bool, generator: torch.Generator | None = None
) -> Tensor:
    r"""Return 8-bit levels as brightness in [0, 1].

    That is :math:`v / 255`, or with ``dequantise`` :math:`(v + u) / 256` with
    :math:`u \sim \mathcal{U}(0, 1)` for every pixel and channel, which gives images a
    density.

    Example:
        >>> as_brightness(torch.tensor([0.0, 51.0, 255.0]), dequantise=False)
        tensor([0.0000, 0.2000, 1.0000])
    """
    if not dequantise:
        return levels / MAX_LEVEL
    uniform = torch.rand(
        levels.shape, dtype=levels.dtype, device=levels.device, generator=generator
    )
    return (levels + uniform) / (MAX_LEVEL + 1)


def malus(angles: Tensor) -> Tensor:
    r"""Return the share of light that passes, :math:`\cos^2`, shape ``(n, 1)``.

    The angles of the two polarisers are in degrees, shape ``(n, 2)``.
    """
    return torch.deg2rad(angles[:, :1] - angles[:, 1:]).cos() ** 2


def draw_crowded(n: int) -> Tensor:
    """Draw parameters by the protocol of the beta-binomial experiment.

    Colours are beta-binomial on 0 ... 255, and angles on the whole degrees from -180
    to 180, all with both shapes 5 (``betabinom.py`` among the generators of
    ``lt_camera_v1``).
    """
    five = torch.tensor(5.0, dtype=torch.float64)

    def levels(count: int, highest: int) -> Tensor:
        chance = Beta(five, five).sample(torch.Size((n, count)))
        return Binomial(highest, probs=chance).sample()

    colours, angles = levels(3, MAX_LEVEL), levels(2, 360) - 180
    return torch.cat([colours, malus(angles)], dim=1).float()


def _masked(colour: Tensor, image_size: int) -> Tensor:
    """Return hexagons in the given colours ``(n, 3)`` on black."""
    mask = hexagon_mask(image_size, like=colour)
    return colour[:, :, None, None] * mask
