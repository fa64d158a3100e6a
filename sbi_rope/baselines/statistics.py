r"""The statistics that NNPE, RNPE and RVNP put errors on."""

import copy
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope.baselines.networks import fit_rows
from sbi_rope.data.pairs import split_pairs
from sbi_rope.density import Density, Flow
from sbi_rope.npe.sbi import (
    ConditionalDensityEstimator,
    check_density,
    embed,
    embedding_of,
    estimator_of,
    headless,
    with_embedding,
)
from sbi_rope.training.ensemble import Ensemble, embedded, log_density
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.tensors import as_batch

NoiseOn = Literal["embedding", "input"]
# Where the logarithmic scale begins, in standard deviations, and the smallest of those.
CLIP, SMALLEST = 3.0, 1e-20


def split_at_statistics(
    estimator: Any, noise_on: NoiseOn
) -> tuple[nn.Module, ConditionalDensityEstimator]:
    r"""Return the map from x to statistics s and :math:`q(\theta \mid s)`.

    Both share their parameters with the estimator; s is h(x), or x itself.
    """
    check_density(estimator)
    if noise_on == "input":
        return nn.Identity(), estimator
    return embedding_of(estimator), headless(estimator)


def frozen_statistics(npe: Any) -> tuple[nn.Module, ConditionalDensityEstimator]:
    r"""Return h and :math:`q(\theta \mid h(x))` of NPE, as frozen copies."""
    estimator = copy.deepcopy(estimator_of(npe)).eval()
    estimator.requires_grad_(requires_grad=False)
    return split_at_statistics(estimator, "embedding")


class OverDraws(Flow):
    r"""NPE averaged over K embeddings :math:`s_k` that may be behind an observation.

    .. math:: \tfrac1K \sum_k q(\theta \mid s_k)

    A subclass returns these from ``embed``, ``(n, *event)`` to ``(n, K, l)``, with the
    help of the net.
    """

    def __init__(
        self,
        net: nn.Module,
        density: ConditionalDensityEstimator,
        num_draws: int,
        event_shape: torch.Size,
    ) -> None:
        super().__init__(
            Ensemble([net], embedded, ()),
            Ensemble([density], log_density, ()),
            density.input_shape,
            event_shape,
            torch.full((num_draws,), 1 / num_draws).double(),
        )

    readable = Density.readable  # what is finite


def statistics_of(net: nn.Module, x: Tensor) -> Tensor:
    """Return the statistics of observations, which must be vectors ``(n, l)``."""
    s = embed(net, x)
    return as_batch("statistics of x", s, s.shape[-1:])


class SoftClip(nn.Module):
    r"""Statistics on a logarithmic scale beyond three standard deviations.

    .. math::
        z \mapsto \begin{cases} z & |z| \le c \\
        \operatorname{sign}(z)\, c\, (1 + \log (|z| / c)) & |z| > c \end{cases}

    with z a statistic in standard deviations from its mean over simulations and c = 3.
    It keeps networks from inputs that are hundreds of times larger than simulations.
    Statistics that are the same in all simulations stay at that value.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, simulated: Tensor) -> None:
        super().__init__()
        std, mean = torch.std_mean(simulated, dim=0)
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, statistics: Tensor) -> Tensor:
        """Return statistics in their own units, of the same shape."""
        z = (statistics - self.mean) / self.std.clamp_min(SMALLEST)
        outside = z.abs().clamp_min(CLIP)
        clipped = z.sign() * CLIP * (1 + (outside / CLIP).log())
        # Where nothing is clipped, not even the rounding of NPE's input changes.
        return statistics.where(z.abs() <= CLIP, self.mean + self.std * clipped)


def clipped_statistics(
    npe: Any, noise_on: NoiseOn, x: Tensor
) -> tuple[nn.Module, SoftClip, Any, Any]:
    r"""Return the parts of a copy of NPE that clips its statistics s.

    That is, the map from x to s; their clip by simulations x; :math:`q(\theta \mid s)`
    and :math:`q(\theta \mid x)`, which share their parameters.
    """
    estimator = copy.deepcopy(estimator_of(npe)).requires_grad_()
    net, density = split_at_statistics(estimator, noise_on)
    clip = SoftClip(embed(net, x))
    density = with_embedding(density, nn.Sequential(clip, embedding_of(density)))
    if noise_on == "input":
        return net, clip, density, density
    return net, clip, density, with_embedding(estimator, nn.Sequential(net, clip))


def fit_with_jitter(
    density: Any,
    s: Tensor,
    theta: Tensor | None = None,
    *,
    jitter: float,
    training: Training,
    **options: Any,
) -> History:
    r"""Train a density of statistics, given theta if there is one.

    Gaussian noise of standard deviation ``jitter`` is drawn anew for every batch:
    without it, statistics that depend on each other have no density.
    """

    def loss(rows: Tensor) -> Tensor:
        noisy = s[rows] + jitter * torch.randn_like(s[rows])
        given = {} if theta is None else {"condition": theta[rows]}
        return density.loss(noisy, **given).mean()

    groups = torch.arange(len(s)) if theta is None else theta
    split = split_pairs(groups, training.validation_fraction)
    return fit_rows(density, loss, split, training, **options)
