r"""The networks of the HVAE: a conditional U-Net and an encoder of latents."""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sbi_rope.baselines.networks import embedding_with_head

__all__ = ["ConditionalUNet", "LatentEncoder", "bounded"]

NUM_POOLINGS = 4
MIN_SIZE = 2**NUM_POOLINGS
# Log-variances stay within, so that standard deviations are between 1/150 and 150.
LOG_VARIANCE_BOUND = 10.0
# Hidden units of the encoder where the estimator has no embedding net of its own.
HIDDEN = 64


class ConditionalUNet(nn.Module):
    r"""A U-Net from a series or image and a latent vector to a Gaussian over the same.

    Five blocks of two convolutions with 1, 2, 4, 8 and 16 times ``width`` channels and
    maxima over neighbours between them; the latent vector joins the last as constant
    channels; four up-convolutions follow, each with a block that also sees the block of
    its size on the way down. With ``residual`` the mean is the input plus the output of
    the network, which starts at zero.

    Data are standardised inside, with one mean and one standard deviation a channel, so
    that pixels that never change do no harm, and padded with their last values to
    multiples of 16. In standardised units log-variances are :math:`10 \tanh(v / 10)`.

    Where this differs from the paper: its listing has five up-convolutions for four
    poolings, and no outputs for the log-variance.

    References:
        | U-Net: Convolutional Networks for Biomedical Image Segmentation (Ronneberger
          et al., 2015)
        | https://arxiv.org/abs/1505.04597

    Args:
        event_shape: ``(length,)`` of a series or ``(channels, height, width)`` of an
            image.
        latent_dim: Length of the latent vector.
        width: Channels of the first block; the paper has 64.
        mean: Mean of the data, shape ``(channels,)``; 0 if None.
        std: Standard deviation of the data, shape ``(channels,)``; 1 if None.
        residual: Whether the mean starts at the input.
        log_variance: Where the log-variance starts, in standardised units.

    Example:
        >>> net = ConditionalUNet((50,), 5, width=4)
        >>> mean, log_variance = net(torch.randn(3, 50), torch.randn(3, 5))
        >>> mean.shape, log_variance.shape
        (torch.Size([3, 50]), torch.Size([3, 50]))
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        event_shape: tuple[int, ...],
        latent_dim: int,
        *,
        width: int = 64,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        residual: bool = True,
        log_variance: float = 0.0,
    ) -> None:
        super().__init__()
        # A series is an image of one channel with one side.
        self.shape = event_shape if len(event_shape) == 3 else (1, *event_shape)
        self.residual = residual
        self.log_variance = log_variance
        channels, *sides = self.shape
        column = (channels, *(1 for _ in sides))
        mean = torch.zeros(channels) if mean is None else mean
        std = torch.ones(channels) if std is None else std
        self.register_buffer("mean", mean.reshape(column))
        self.register_buffer("std", std.reshape(column))

        is_series = len(sides) == 1
        self.pool = nn.MaxPool1d(2) if is_series else nn.MaxPool2d(2)
        up = nn.ConvTranspose1d if is_series else nn.ConvTranspose2d
        widths = [width * 2**level for level in range(NUM_POOLINGS + 1)]
        self.down = nn.ModuleList(
            _block(before, after, is_series=is_series)
            for before, after in pairwise((channels, *widths))
        )
        self.enlarge, self.up = nn.ModuleList(), nn.ModuleList()
        for before, after in pairwise(reversed(widths)):
            extra = latent_dim if before == widths[-1] else 0
            self.enlarge.append(up(before + extra, after, 2, stride=2))
            self.up.append(_block(2 * after, after, is_series=is_series))
        conv = nn.Conv1d if is_series else nn.Conv2d
        self.head = conv(width, 2 * channels, 1)
        if residual:
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance in the units of x, ``(n * S, *event)``.

        Args:
            x: Series or images, shape ``(n, *event)``.
            z: Latent vectors, S for the first x, then S for the second and so on, shape
                ``(n * S, latent_dim)``.
        """
        inputs = (x.reshape(len(x), *self.shape) - self.mean) / self.std
        outputs = self._outputs(_padded(inputs), z)
        for dim, side in enumerate(self.shape[1:], start=2):
            outputs = outputs.narrow(dim, 0, side)
        mean, log_variance = outputs.chunk(2, dim=1)
        if self.residual:
            mean = _repeated(inputs, len(z)) + mean
        log_variance = bounded(self.log_variance + log_variance) + 2 * self.std.log()
        mean = self.mean + self.std * mean
        shape = (len(z), *x.shape[1:])
        return mean.reshape(shape), log_variance.reshape(shape)

    def _outputs(self, x: Tensor, z: Tensor) -> Tensor:
        skips: list[Tensor] = []
        for block in self.down:
            x = block(self.pool(x) if skips else x)
            skips.append(x)
        x = _repeated(skips.pop(), len(z))
        sides = x.shape[2:]
        z = z.reshape(*z.shape, *(1 for _ in sides)).expand(-1, -1, *sides)
        x = torch.cat([x, z], dim=1)
        for enlarge, block in zip(self.enlarge, self.up, strict=True):
            x = block(torch.cat([enlarge(x), _repeated(skips.pop(), len(x))], dim=1))
        return self.head(x)


class LatentEncoder(nn.Module):
    r"""A diagonal Gaussian over latent vectors, predicted from an observation.

    A copy of an embedding net that starts anew (all modules that have a
    ``reset_parameters``, as those of torch do), and a linear layer for mean and
    log-variance, which is bounded to :math:`10 \tanh(v / 10)`. Where the embedding net
    has no parameters, two hidden layers of 64 units follow it.

    Args:
        embedding: Maps observations ``(n, *event)`` to embeddings ``(n, l)``.
        latent_dim: Length of the latent vector.
        x: Some observations, to learn the width of an embedding.

    Example:
        >>> encoder = LatentEncoder(torch.nn.Flatten(), 5, torch.randn(2, 20))
        >>> encoder(torch.randn(3, 20))[0].shape
        torch.Size([3, 5])
    """

    def __init__(self, embedding: nn.Module, latent_dim: int, x: Tensor) -> None:
        super().__init__()
        self.net = embedding_with_head(embedding, 2 * latent_dim, x)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance, each ``(n, latent_dim)``."""
        mean, log_variance = self.net(x).chunk(2, dim=1)
        return mean, bounded(log_variance)


def bounded(log_variance: Tensor) -> Tensor:
    """Return log-variances in (-10, 10), nearly the same about 0."""
    return LOG_VARIANCE_BOUND * torch.tanh(log_variance / LOG_VARIANCE_BOUND)


def _block(before: int, after: int, *, is_series: bool) -> nn.Sequential:
    """Return two convolutions; batch normalisation between them in images alone."""
    layers: list[nn.Module] = []
    for channels in (before, after):
        if is_series:
            layers += [nn.Conv1d(channels, after, 3, padding=1), nn.ReLU()]
        else:
            layers += [
                nn.Conv2d(channels, after, 3, padding=1, bias=False),
                nn.BatchNorm2d(after),
                nn.ReLU(),
            ]
    return nn.Sequential(*layers)


def _repeated(x: Tensor, num_rows: int) -> Tensor:
    return x.repeat_interleave(num_rows // len(x), dim=0)


def _padded(x: Tensor) -> Tensor:
    """Repeat the last values until all sides are multiples of 16."""
    missing = [-side % MIN_SIZE for side in reversed(x.shape[2:])]
    return F.pad(x, [n for m in missing for n in (0, m)], mode="replicate")
