"""Networks of the baselines: around an embedding net, and a U-Net."""

import copy
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sbi_rope._sbi import embed
from sbi_rope._standardisation import ROUNDING

__all__ = ["ConditionalUNet", "bounded", "embedding_with_head", "fresh_copy"]

# Units of the hidden layers where an estimator has no embedding net of its own.
HIDDEN = 64
# Maxima over neighbours on the way down a U-Net.
NUM_POOLINGS = 4
# Log-variances stay within, so that standard deviations are between 1/150 and 150.
LOG_VARIANCE_BOUND = 10.0


def fresh_copy(module: nn.Module) -> nn.Module:
    """Copy a network and draw its parameters anew.

    That is, those of all modules with a ``reset_parameters``, as torch's have. What
    standardises keeps its constants.
    """
    module = copy.deepcopy(module).requires_grad_()
    # The outer ones last, whose own way to start overrules that of their parts.
    for part in reversed(list(module.modules())):
        if callable(getattr(part, "reset_parameters", None)):
            part.reset_parameters()  # type: ignore[operator]
    return module


def embedding_with_head(
    embedding: nn.Module, num_outputs: int, x: Tensor
) -> nn.Sequential:
    """Return a fresh embedding net followed by a linear layer.

    Where the embedding has no parameters, two hidden layers of 64 units stand between.
    Its width is that of the embedding of x.
    """
    embedding = fresh_copy(embedding)
    width = embed(embedding, x[:1]).flatten(1).shape[1]
    layers: list[nn.Module] = []
    if not any(True for _ in embedding.parameters()):
        for before in (width, HIDDEN):
            layers += [nn.Linear(before, HIDDEN), nn.ReLU()]
        width = HIDDEN
    return nn.Sequential(
        embedding, nn.Flatten(), *layers, nn.Linear(width, num_outputs)
    )


class ConditionalUNet(nn.Module):
    r"""A U-Net from a series or image and a latent vector to a Gaussian over the same.

    Five blocks of two convolutions with 1, 2, 4, 8 and 16 times ``width`` channels and
    maxima over neighbours between them; the latent vector joins the last as constant
    channels; four up-convolutions follow, each with a block that also sees the block of
    its size on the way down. The mean is the input plus the output of the network,
    which starts at zero.

    Data are standardised inside, with one mean and one standard deviation a channel, so
    that pixels that never change do no harm, and padded with their last values to
    multiples of 16. In standardised units log-variances are :math:`10 \tanh(v / 10)`.

    References:
        | U-Net: Convolutional Networks for Biomedical Image Segmentation (Ronneberger
          et al., 2015)
        | https://arxiv.org/abs/1505.04597

    The data are series, ``(n, length)``, or images, ``(n, channels, height, width)``.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, data: Tensor, latent_dim: int, *, width: int) -> None:
        super().__init__()
        # A series is an image of one channel with one side.
        self.shape = data.shape[1:] if data.ndim == 4 else (1, *data.shape[1:])
        channels, *sides = self.shape
        of_each = data.reshape(-1, *self.shape).transpose(0, 1).flatten(1)
        std, mean = torch.std_mean(of_each, dim=1)
        # A channel that only rounding changes has no standard deviation.
        std = std.where(std > ROUNDING * mean.abs(), 1.0)
        column = (channels, *(1 for _ in sides))
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
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance in the units of x, ``(n * S, *event)``.

        Of the latent vectors, ``(n * S, latent_dim)``, the first S are for the first x.
        """
        inputs = (x.reshape(len(x), *self.shape) - self.mean) / self.std
        outputs = self._outputs(_padded(inputs), z)
        for dim, side in enumerate(self.shape[1:], start=2):
            outputs = outputs.narrow(dim, 0, side)
        mean, log_variance = outputs.chunk(2, dim=1)
        mean = self.mean + self.std * (_repeated(inputs, len(z)) + mean)
        log_variance = bounded(log_variance) + 2 * self.std.log()
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


def bounded(log_variance: Tensor) -> Tensor:
    """Return log-variances in (-10, 10), nearly the same about 0."""
    return LOG_VARIANCE_BOUND * torch.tanh(log_variance / LOG_VARIANCE_BOUND)


def _block(before: int, after: int, *, is_series: bool) -> nn.Sequential:
    """Return two convolutions; batch normalisation between them in images alone."""
    conv = nn.Conv1d if is_series else nn.Conv2d
    layers: list[nn.Module] = []
    for channels in (before, after):
        layers.append(conv(channels, after, 3, padding=1, bias=is_series))
        layers += [] if is_series else [nn.BatchNorm2d(after)]
        layers.append(nn.ReLU())
    return nn.Sequential(*layers)


def _repeated(x: Tensor, num_rows: int) -> Tensor:
    return x.repeat_interleave(num_rows // len(x), dim=0)


def _padded(x: Tensor) -> Tensor:
    """Repeat the last values until all sides can be halved by each pooling."""
    missing = [-side % 2**NUM_POOLINGS for side in reversed(x.shape[2:])]
    return F.pad(x, [n for m in missing for n in (0, m)], mode="replicate")
