r"""The statistics that NNPE, RNPE and RVNP put errors on."""

import copy
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    UnconditionalDensityEstimator,
    build_zuko_unconditional_flow,
    check_density,
    embedding_of,
    estimator_of,
    headless,
    with_embedding,
)
from sbi_rope._standardisation import Standardisation
from sbi_rope.baselines.networks import fit_rows
from sbi_rope.data import split_pairs
from sbi_rope.density import Density, Flow
from sbi_rope.ensemble import Ensemble, embedded, log_density
from sbi_rope.fit import History, Training
from sbi_rope.tensors import as_batch

__all__ = [
    "NoiseOn",
    "OverDraws",
    "SoftClip",
    "fit_marginal",
    "fit_with_jitter",
    "frozen_statistics",
    "split_at_statistics",
    "standardisation_of_statistics",
    "with_clip",
]

NoiseOn = Literal["embedding", "input"]
# Hidden units and transforms of the marginal density. A single spline transform is
# evaluated in half the time of two, and the denoising does little else.
HIDDEN, NUM_TRANSFORMS = 64, 1
# Of the networks' outputs at the start.
SHRINKAGE = 0.01
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
    return split_at_statistics(
        estimator.requires_grad_(requires_grad=False), "embedding"
    )


class OverDraws(Flow):
    r"""NPE averaged over K embeddings :math:`s_k` that may be behind an observation.

    .. math:: \tfrac1K \sum_k q(\theta \mid s_k)

    A subclass returns these from ``embed``, ``(n, *event)`` to ``(n, K, l)``.

    Args:
        net: A network that the subclass embeds with.
        density: :math:`q(\theta \mid s)`.
        num_draws: K.
        event_shape: Shape of one observation.
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
            torch.full((num_draws,), 1 / num_draws).double(),
            input_shape=density.input_shape,
            condition_shape=event_shape,
        )

    readable = Density.readable  # what is finite


def standardisation_of_statistics(statistics: Tensor) -> Standardisation:
    """Return the map from statistics to standard deviations of these, ``(n, l)``.

    They are refused if they are no vectors, or not finite.
    """
    return Standardisation(
        as_batch("statistics of x", statistics, statistics.shape[-1:])
    )


class SoftClip(nn.Module):
    r"""Statistics on a logarithmic scale beyond three standard deviations.

    .. math::
        z \mapsto \begin{cases} z & |z| \le c \\
        \operatorname{sign}(z)\, c\, (1 + \log (|z| / c)) & |z| > c \end{cases}

    with z a statistic in standard deviations from its mean over simulations and c = 3.
    It loses nothing and changes nothing where simulations are, but keeps networks from
    inputs that are hundreds of times larger than those. Statistics that are the same
    in all simulations stay at that value.
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


def with_clip(estimator: Any, clip: SoftClip, noise_on: NoiseOn) -> tuple[Any, Any]:
    r"""Return :math:`q(\theta \mid s)` and :math:`q(\theta \mid x)` that clip s.

    Both share their parameters with the estimator, and are the same if s is x.
    """
    net, density = split_at_statistics(estimator, noise_on)
    density = with_embedding(density, nn.Sequential(clip, embedding_of(density)))
    if noise_on == "input":
        return density, density
    return density, with_embedding(estimator, nn.Sequential(net, clip))


def fit_marginal(
    s: Tensor, *, jitter: float, training: Training, show_progress_bars: bool
) -> tuple[UnconditionalDensityEstimator, History]:
    r"""Fit a neural spline flow :math:`q(s)` to standardised simulated statistics.

    It starts as a standard normal density and stays like it where there are no
    simulations, which is where misspecified statistics are. The jitter is the standard
    deviation of Gaussian noise on s, without which statistics that depend on each other
    have no density.
    """
    flow = build_zuko_unconditional_flow(
        "NSF",
        s.cpu(),
        z_score_x="none",
        hidden_features=[HIDDEN, HIDDEN],
        num_transforms=NUM_TRANSFORMS,
    )
    _start_as_standard_normal(flow)
    flow = flow.to(s.device)
    history = fit_with_jitter(
        flow,
        lambda rows, noisy: flow.loss(noisy),
        s,
        torch.arange(len(s)),
        jitter=jitter,
        training=training,
        label="Density of the statistics",
        show_progress_bars=show_progress_bars,
    )
    return flow, history


def fit_with_jitter(
    density: nn.Module,
    losses: Callable[[Tensor, Tensor], Tensor],
    s: Tensor,
    groups: Tensor,
    *,
    jitter: float,
    training: Training,
    **options: Any,
) -> History:
    """Train a density of statistics with Gaussian noise on them, anew in every batch.

    The losses are those at some rows and their noisy statistics. Rows of a group are
    held out together. Other options are those of :func:`~sbi_rope.fit.fit`.
    """

    def loss(rows: Tensor) -> Tensor:
        return losses(rows, s[rows] + jitter * torch.randn_like(s[rows])).mean()

    split = split_pairs(groups, training.validation_fraction)
    return fit_rows(density, loss, split, training, **options)


@torch.no_grad()
def _start_as_standard_normal(flow: nn.Module) -> None:
    """Shrink the outputs of the networks, at zero of which splines are the identity."""
    for module in flow.modules():
        if isinstance(module, nn.Sequential) and isinstance(module[-1], nn.Linear):
            outputs = module[-1]
        elif isinstance(module, nn.ParameterList):
            outputs = module  # a single statistic, with no network
        else:
            continue
        for parameter in outputs.parameters():
            parameter.mul_(SHRINKAGE)
