r"""The generative model of the HVAE, its approximate posterior, and the ELBO."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal, kl_divergence

from sbi_rope.baselines.networks import embedding_with_head
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.standardisation import ROUNDING

# Length over which the continued density falls by a factor of e, and how far inside
# its ends the support is cut, in standard deviations of the prior. Some densities, that
# of the light tunnel's polarisers for one, are infinite at the ends.
FLANK, MARGIN = 0.1, 1e-3
# Maxima over neighbours on the way down a U-Net.
NUM_POOLINGS = 4
# Log-variances stay within, so that standard deviations are between 1/150 and 150.
LOG_VARIANCE_BOUND = 10.0


class HybridVAE(nn.Module):
    r"""Real observations as physics seen through a network with a latent vector.

    The model is :math:`\theta \sim p(\theta)`, :math:`z \sim \mathcal{N}(0, I)` and
    :math:`x_o \sim \mathrm{P2R}(f(\theta), z)`; its approximate posterior, that of
    :class:`~sbi_rope.baselines.HVAE`. Each network returns a Gaussian; of that of R2P
    the mean is taken.
    """

    def __init__(
        self,
        encoder: nn.Module,
        reality_to_physics: nn.Module,
        physics_to_reality: nn.Module,
        *,
        npe: tuple[nn.Module, Any],
        physics: Callable[[Tensor], Tensor],
        prior: "ContinuedPrior",
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.reality_to_physics = reality_to_physics
        self.physics_to_reality = physics_to_reality
        # A tuple is not a submodule: neither optimisers nor train() get to it.
        self.npe = npe
        self.physics = physics
        self.prior = prior

    def _infer(self, x_o: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw z, and return its divergence from the prior and h of a simulation."""
        law = self.encoder(x_o)
        z = law.rsample()
        standard = Normal(torch.zeros_like(z), torch.ones_like(z))
        kl = kl_divergence(law, Independent(standard, 1))
        return z, kl, self.npe[0](self.reality_to_physics(x_o, z).mean)

    def elbo(self, x_o: Tensor) -> Tensor:
        """Return an estimate of the ELBO from one draw each, ``(n,)``, in nats."""
        z, kl, s = self._infer(x_o)
        theta = reparametrised_sample(self.npe[1], s)
        log_q = self.npe[1].log_prob(theta[None], s)[0]
        explained = self.physics_to_reality(self.physics(self.prior.nearest(theta)), z)
        return explained.log_prob(x_o) - kl - log_q + self.prior.log_prob(theta)

    def objective(self, x_o: Tensor, theta: Tensor, x: Tensor) -> Tensor:
        """Return what is minimised: pairs weigh like all entries of an observation.

        Observations x_o are ``(n, *event)``; pairs, ``(m, d)`` and ``(m, *event)``.
        """
        _, _, s = self._infer(x)
        log_prob = self.npe[1].log_prob(theta[None], s)
        return -self.elbo(x_o).mean() - x_o[0].numel() * log_prob.mean()


class LatentEncoder(nn.Module):
    """A Gaussian over latent vectors, given by an embedding net that starts anew."""

    def __init__(self, embedding: nn.Module, latent_dim: int, x: Tensor) -> None:
        super().__init__()
        self.net = embedding_with_head(embedding, 2 * latent_dim, x)

    def forward(self, x: Tensor) -> Independent:
        """Return the Gaussians over latent vectors of observations."""
        mean, log_variance = self.net(x).chunk(2, dim=1)
        return _gaussian(mean, _bounded(log_variance))


class ContinuedPrior:
    r"""A prior on a box whose density falls off outside of it instead of ending.

    With :math:`\bar\theta` the nearest point in the box and :math:`s` the standard
    deviations of the prior,

    .. math::
        \log \tilde p(\theta) = \log p(\bar\theta)
        - \sum_k \frac{|\theta_k - \bar\theta_k|}{0.1\, s_k}.

    A flow has some mass outside of the support, where the ELBO would be minus infinity.
    This one is finite, and its gradient leads back inside.
    """

    def __init__(self, prior: Distribution) -> None:
        self._prior = PriorDistribution(prior)
        self.std = self._prior.stddev
        low, high = self._prior.bounds(self.std)
        self.low, self.high = low + MARGIN * self.std, high - MARGIN * self.std

    def nearest(self, theta: Tensor) -> Tensor:
        """Return the nearest points in the box, ``(n, d)``."""
        return theta.clamp(self.low, self.high)

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the continued log density, ``(n, d)`` to ``(n,)``."""
        inside = self.nearest(theta)
        distance = ((theta - inside).abs() / (FLANK * self.std)).sum(dim=1)
        return self._prior.log_prob(inside) - distance


def reparametrised_sample(flow: Any, condition: Tensor) -> Tensor:
    r"""Draw one theta a condition, differentiable with respect to the condition.

    A flow maps theta to noise :math:`u = T(\theta; s)`. At fixed noise the theorem on
    implicit functions gives

    .. math::
        \frac{\partial \theta}{\partial s} = -\left(
        \frac{\partial T}{\partial \theta} \right)^{-1} \frac{\partial T}{\partial s}.

    Only :math:`T` is differentiated, so that flows may be inverted by a search.
    Conditions are ``(n, l)``, and parameters ``(n, d)``.
    """
    with torch.no_grad():
        theta = flow.sample(torch.Size((1,)), condition)[0]
    point = theta.requires_grad_()
    noise = flow.inverse_transform(point, condition)
    rows = [
        torch.autograd.grad(entry.sum(), point, retain_graph=True)[0]
        for entry in noise.unbind(dim=1)
    ]
    zero = noise - noise.detach()  # but for its gradient
    step = torch.linalg.solve(torch.stack(rows, dim=1), zero.unsqueeze(2))
    return theta.detach() - step.squeeze(2)


class ConditionalUNet(nn.Module):
    r"""A U-Net from a series or image and a latent vector to a Gaussian over the same.

    Five blocks of two convolutions with 1, 2, 4, 8 and 16 times ``width`` channels; the
    latent vector joins the last as constant channels; four up-convolutions follow, each
    with a block that also sees the block of its size on the way down. The mean is the
    input plus the output, which starts at zero. Each channel of the data, ``(n,
    length)`` or ``(n, channels, height, width)``, is standardised inside.

    References:
        | U-Net: Convolutional Networks for Biomedical Image Segmentation (Ronneberger
          et al., 2015)
        | https://arxiv.org/abs/1505.04597
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

    def forward(self, x: Tensor, z: Tensor) -> Independent:
        """Return the Gaussians in the units of x, over ``(n * S, *event)``.

        Of the latent vectors, ``(n * S, latent_dim)``, the first S are for the first x.
        """
        inputs = (x.reshape(len(x), *self.shape) - self.mean) / self.std
        outputs = self._outputs(_padded(inputs), z)
        for dim, side in enumerate(self.shape[1:], start=2):
            outputs = outputs.narrow(dim, 0, side)
        mean, log_variance = outputs.chunk(2, dim=1)
        mean = self.mean + self.std * (_repeated(inputs, len(z)) + mean)
        log_variance = _bounded(log_variance) + 2 * self.std.log()
        shape = (len(z), *x.shape[1:])
        return _gaussian(mean.reshape(shape), log_variance.reshape(shape))

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


def _gaussian(mean: Tensor, log_variance: Tensor) -> Independent:
    std = (0.5 * log_variance).exp()
    return Independent(Normal(mean, std, validate_args=False), mean.ndim - 1)


def _bounded(log_variance: Tensor) -> Tensor:
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
