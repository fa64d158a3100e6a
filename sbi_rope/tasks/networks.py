r"""The embedding networks of the tasks."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

CHANNELS = (1, 16, 64, 128, 128, 128, 128, 128)
STRIDES = (1, 2, 1, 2, 1, 2, 1)
POOLS = ((3, 1), (3, 1), (3, 1))
HEAD = (512, 128, 32)
# Squares along each side of an image of which the light network takes means.
NUM_MEANS = 10
LAST_BIAS = 0.1


class SeriesEmbedding(nn.Module):
    r"""One-dimensional convolutional network for a single time series.

    Seven convolutions with kernel 3 and dilation 2, means over neighbours after the
    second, fourth and sixth, and four linear layers, all with ReLU in between. A dummy
    pass finds the number of features between the two halves, 2048 for a series of 200
    steps.

    Args:
        num_steps: Length of the series.
        output_dim: Number of statistics to return.
        padding: Zeros added at each end before every convolution. The paper's 1
            shortens the series at every layer and needs at least 73 steps; 2 keeps
            the length (up to the strides), for shorter series.
        pools: Number of neighbours and stride of each of the three means.
        decimation: Every how many steps one is taken, the others are not looked at.

    Example:
        >>> SeriesEmbedding(num_steps=200, output_dim=10)(torch.zeros(5, 200)).shape
        torch.Size([5, 10])
    """

    def __init__(
        self,
        *,
        num_steps: int = 200,
        output_dim: int = 10,
        padding: int = 1,
        pools: Sequence[tuple[int, int]] = POOLS,
        decimation: int = 1,
    ) -> None:
        super().__init__()
        self.num_steps = num_steps
        self.decimation = decimation
        self.features = _convolutions(padding, pools)
        with torch.no_grad():
            series = torch.zeros(1, 1, num_steps)[..., ::decimation]
            self.num_features = self.features(series).shape[1]
        self.head = fully_connected(self.num_features, (*HEAD, output_dim))

    def forward(self, x: Tensor) -> Tensor:
        """Embed series of shape ``(n, num_steps)`` as ``(n, output_dim)``."""
        return self.head(self.features(x[:, :: self.decimation].unsqueeze(1)))


def fully_connected(input_dim: int, widths: Sequence[int]) -> nn.Sequential:
    """Return linear layers of these widths with ReLU between, none after the last.

    Example:
        >>> fully_connected(7, (64, 8))
        Sequential(
          (0): Linear(in_features=7, out_features=64, bias=True)
          (1): ReLU()
          (2): Linear(in_features=64, out_features=8, bias=True)
        )
    """
    layers: list[nn.Module] = []
    for before, after in zip((input_dim, *widths), widths, strict=False):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def light_series_embedding(*, num_steps: int, output_dim: int) -> nn.Sequential:
    """Return a small convolutional network for a single time series, for CPUs.

    Three convolutions with kernel 5 and stride 2, to 32 channels, and two linear
    layers: about a thirtieth of the work of :class:`SeriesEmbedding` at 200 steps.

    Example:
        >>> net = light_series_embedding(num_steps=50, output_dim=10)
        >>> net(torch.zeros(5, 50)).shape
        torch.Size([5, 10])
    """
    layers: list[nn.Module] = [nn.Unflatten(1, (1, num_steps))]
    length = num_steps
    for before, after in ((1, 16), (16, 32), (32, 32)):
        layers += [nn.Conv1d(before, after, 5, stride=2, padding=2), nn.ReLU()]
        length = (length + 1) // 2
    return nn.Sequential(
        *layers, nn.Flatten(), fully_connected(32 * length, (64, output_dim))
    )


def _convolutions(padding: int, pools: Sequence[tuple[int, int]]) -> nn.Sequential:
    layers: list[nn.Module] = []
    means = iter(pools)
    for i, stride in enumerate(STRIDES):
        layers += [
            nn.Conv1d(
                CHANNELS[i], CHANNELS[i + 1], 3, stride, dilation=2, padding=padding
            ),
            nn.ReLU(),
        ]
        if stride == 2:
            size, step = next(means)
            layers.append(nn.AvgPool1d(size, stride=step))
    return nn.Sequential(*layers, nn.Flatten())


class ImageEmbedding(nn.Module):
    r"""Two-dimensional convolutional network for square colour images.

    Three convolutions with kernel 3 and stride 2 (a maximum over 3 x 3 pixels after
    the second), two with kernel 1, and two linear layers, all with ReLU in between. A
    dummy pass finds the number of features between the two halves: 27 for images of
    100 x 100 pixels, 12 for 64 x 64.

    The last convolution, whose three channels lead straight into a ReLU, starts with
    biases of 0.1. As torch starts it, all three are 0 for every image in one network
    out of ten, which then cannot learn.

    Args:
        image_size: Height and width of the images, in pixels.
        output_dim: Number of statistics to return.
        light: Whether to replace the convolutions by means over squares, about 10 by
            10 of them, and three linear layers.

    Example:
        >>> ImageEmbedding(image_size=64)(torch.zeros(5, 3, 64, 64)).shape
        torch.Size([5, 20])
    """

    def __init__(
        self, *, image_size: int = 100, output_dim: int = 20, light: bool = False
    ) -> None:
        super().__init__()
        means = nn.Sequential(nn.AvgPool2d(image_size // NUM_MEANS), nn.Flatten())
        self.features = means if light else _image_convolutions()
        with torch.no_grad():
            image = torch.zeros(1, 3, image_size, image_size)
            self.num_features = self.features(image).shape[1]
        hidden = (64, 64) if light else (100,)
        self.head = fully_connected(self.num_features, (*hidden, output_dim))

    def forward(self, x: Tensor) -> Tensor:
        """Embed images of shape ``(n, 3, size, size)`` as ``(n, output_dim)``."""
        return self.head(self.features(x))


class _LastConvolution(nn.Conv2d):
    """A convolution whose biases start, and start again, above zero."""

    def reset_parameters(self) -> None:
        """Draw the weights and set the biases."""
        super().reset_parameters()
        nn.init.constant_(self.bias, LAST_BIAS)  # type: ignore[arg-type]


def _image_convolutions() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(),
        nn.Conv2d(64, 128, 3, stride=2),
        nn.ReLU(),
        nn.MaxPool2d(3),
        nn.Conv2d(128, 128, 3, stride=2),
        nn.ReLU(),
        nn.Conv2d(128, 64, 1),
        nn.ReLU(),
        _LastConvolution(64, 3, 1),
        nn.ReLU(),
        nn.Flatten(),
    )
