r"""The embedding networks of the light tunnel's images."""

import torch
from torch import Tensor, nn

from sbi_rope.tasks.networks import fully_connected

__all__ = ["ImageEmbedding"]

# Squares along each side of an image of which the light network takes means.
NUM_MEANS = 10
LAST_BIAS = 0.1


class ImageEmbedding(nn.Module):
    r"""Two-dimensional convolutional network for square colour images.

    Three convolutions with kernel 3 and stride 2 (a maximum over 3 x 3 pixels after
    the second), two with kernel 1, and two linear layers, all with ReLU in between. A
    dummy pass finds the number of features between the two halves: 27 for images of
    100 x 100 pixels, 12 for 64 x 64.

    The last convolution, whose three channels lead straight into a ReLU, starts with
    biases of 0.1. As torch starts it, all three are 0 for every image in one network
    out of ten, which then cannot learn.

    References:
        | Addressing Misspecification in Simulation-based Inference through
          Data-driven Calibration (Wehenkel et al.), algorithm of the 2D CNN
        | https://arxiv.org/abs/2405.08719

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
        self.features = _means(image_size // NUM_MEANS) if light else _convolutions()
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


def _convolutions() -> nn.Sequential:
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


def _means(width: int) -> nn.Sequential:
    return nn.Sequential(nn.AvgPool2d(width), nn.Flatten())
