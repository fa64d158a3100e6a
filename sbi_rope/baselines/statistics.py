r"""The statistics that NNPE, RNPE and RVNP put errors on."""

import copy
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
from sbi_rope.data import split_pairs
from sbi_rope.fit import History, Training, fit, shuffled
from sbi_rope.tensors import as_batch

__all__ = [
    "NoiseOn",
    "SoftClip",
    "fit_marginal",
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

    Args:
        estimator: A trained estimator, whose parameters both share.
        noise_on: Whether s is the ``"embedding"`` h(x), or x itself, the ``"input"``.

    Raises:
        UnsupportedPosteriorError: If the estimator has no density.
    """
    check_density(estimator)
    if noise_on == "input":
        return nn.Identity(), estimator
    return embedding_of(estimator), headless(estimator)


def frozen_statistics(
    posterior: Any,
) -> tuple[nn.Module, ConditionalDensityEstimator]:
    r"""Return h and :math:`q(\theta \mid h(x))` of NPE, as frozen copies.

    Raises:
        UnsupportedPosteriorError: If its estimator has no density.
    """
    estimator = copy.deepcopy(estimator_of(posterior)).eval()
    return split_at_statistics(
        estimator.requires_grad_(requires_grad=False), "embedding"
    )


def standardisation_of_statistics(statistics: Tensor) -> Standardisation:
    """Return the map from statistics to standard deviations of simulated ones.

    Args:
        statistics: Statistics of simulations, shape ``(n, l)``.

    Raises:
        InvalidInputError: If they are no vectors, or not finite.
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

    Args:
        simulated: Statistics of simulations, shape ``(n, *)``.
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

    Args:
        estimator: A trained estimator, whose parameters both share.
        clip: The clip of statistics.
        noise_on: As in :func:`split_at_statistics`.

    Returns:
        The density given statistics, and the one given x. They are the same if x is
        its own statistic.
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
    simulations, which is where misspecified statistics are.

    Args:
        s: Shape ``(n, l)``.
        jitter: Standard deviation of Gaussian noise on s, anew in every batch. Without
            it statistics that depend on each other have no density.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether to show the course of the training.

    Returns:
        The flow, in evaluation mode, and its losses epoch by epoch.
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
    train, held_out = split_pairs(torch.arange(len(s)), training.validation_fraction)

    def batches(step: int) -> Any:
        for rows in shuffled(train, training.training_batch_size):
            yield (s[rows],)

    def loss(batch: Tensor) -> Tensor:
        return flow.loss(batch + jitter * torch.randn_like(batch)).mean()

    [history] = fit(
        flow,
        batches,
        loss,
        training,
        validation_loss=lambda: loss(s[held_out]),
        label="Density of the statistics",
        show_progress_bars=show_progress_bars,
    )
    return flow, history


@torch.no_grad()
def _start_as_standard_normal(flow: nn.Module) -> None:
    """Shrink the outputs of the networks, at zero of which splines are the identity."""
    for module in flow.modules():
        outputs: nn.Module | None = None
        if isinstance(module, nn.Sequential) and isinstance(module[-1], nn.Linear):
            outputs = module[-1]
        elif isinstance(module, nn.ParameterList):
            outputs = module  # a single statistic, with no network
        if outputs is not None:
            for parameter in outputs.parameters():
                parameter.mul_(SHRINKAGE)
