"""Whether what tuning leaves of a calibration pair depends on its parameters."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._progress import progress_bar
from sbi_rope._sbi import embed
from sbi_rope._simulations import draw_targets
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations
from sbi_rope.rope import RoPE

__all__ = [
    "CrossFitted",
    "Dependence",
    "cross_fit",
    "dependence",
    "num_features",
    "residual_finding",
]

NUM_PERMUTATIONS = 1000
LEVEL = 0.01
# The most that averaging over the simulator's noise explains; see `dependence`.
LARGEST_RATIO = 0.5
# Bias below this share of the embeddings' spread is nothing, if there is no noise.
SMALLEST_SHARE = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossFitted:
    r"""Calibration pairs as a g sees them that was not trained on them.

    Attributes:
        embedded: :math:`g(x)`, ``(n_c, l)``.
        targets: :math:`E[h(S(\theta))]`, ``(n_c, l)``.
    """

    embedded: Tensor
    targets: Tensor

    @property
    def residuals(self) -> Tensor:
        """What is between the two, ``(n_c, l)``."""
        return self.embedded - self.targets


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """How much residuals depend on parameters.

    Attributes:
        p_value: Of a permutation test.
        bias: Root mean square of the part that follows the parameters.
        error: Standard error of ``bias``.
    """

    p_value: float
    bias: float
    error: float


def num_features(num_pairs: int, dim: int) -> int:
    """Return how many features of the parameters so many pairs can carry; 0 is none."""
    for count in (2 * dim, dim):
        if num_pairs >= 2 * (count + 1) + 2:
            return count
    return 0


def cross_fit(rope: RoPE, *, num_folds: int, show_progress_bars: bool) -> CrossFitted:
    r"""Embed each calibration pair by a g that was trained on the other folds.

    On the pairs g was trained on, residuals would be too small. Costs as many
    trainings as there are folds.

    Args:
        rope: RoPE with its calibration pairs; it is left as it is.
        num_folds: Folds; as many as there are pairs, if these are fewer.
        show_progress_bars: Whether to show the folds done.
    """
    theta, x = rope.calibration
    h = rope.embedding_net
    targets = draw_targets(
        rope.source,
        theta,
        lambda x: embed(h, x),
        simulations_per_target=rope.finetuner.simulations_per_target,
        num_neighbors=rope.finetuner.num_neighbors,
        progress=False,
    )
    embedded = torch.empty_like(targets)
    order = torch.randperm(len(theta)).to(theta.device)
    folds = order.tensor_split(min(num_folds, len(theta)))
    for held_out in progress_bar(folds, show=show_progress_bars, desc="Folds"):
        others = torch.cat([fold for fold in folds if fold is not held_out])
        part = rope.with_pairs(others, targets=targets[others])
        part.train(show_progress_bars=False)
        embedded[held_out] = embed(part.tuned_embedding_net, x[held_out])
    return CrossFitted(embedded=embedded.cpu().double(), targets=targets.cpu().double())


def dependence(residuals: Tensor, theta: Tensor) -> Dependence:
    r"""Regress residuals on parameters and their squares, and permute.

    The statistic is the sum of squares that the regression explains. The bias
    :math:`b` is its unbiased estimate: with p features and residual variance
    :math:`s^2`, :math:`b^2 = (\text{explained} - p\, s^2) / n`. With few pairs there
    are no squares. Its standard error is about
    :math:`\sqrt{(s^2 + b^2 / 2) / n}`, were all residual variance along the bias.

    Args:
        residuals: Shape ``(n, l)``.
        theta: Parameters, shape ``(n, d)``.
    """
    count = num_features(*theta.shape)
    standard = (theta - theta.mean(dim=0)) / theta.std(dim=0).clamp_min(1e-12)
    features = torch.cat([standard, standard.square()], dim=1)[:, :count]
    features = features - features.mean(dim=0)
    vectors, values, _ = torch.linalg.svd(features, full_matrices=False)
    basis = vectors[:, values > 1e-9 * values.max()]
    centred = residuals - residuals.mean(dim=0)
    explained = float((basis.T @ centred).square().sum())
    permuted = torch.stack(
        [
            (basis.T @ centred[torch.randperm(len(centred))]).square().sum()
            for _ in range(NUM_PERMUTATIONS)
        ]
    )
    # Equal up to rounding counts as reached.
    reached = int((permuted >= explained * (1 - 1e-12)).sum())
    n, p = len(centred), basis.shape[1]
    variance = (float(centred.square().sum()) - explained) / (n - 1 - p)
    square = max(explained - p * variance, 0.0) / n
    return Dependence(
        p_value=(1 + reached) / (1 + NUM_PERMUTATIONS),
        bias=square**0.5,
        error=((variance + square / 2) / n) ** 0.5,
    )


def residual_finding(
    residuals: Tensor, theta: Tensor, simulations: Simulations
) -> Finding:
    r"""Judge the bias, its lower 95 % limit, in units of the simulator's noise.

    Residuals depend on parameters even where all is well. With :math:`h` the posterior
    mean of a linear-Gaussian problem that explains a share R of the variance, the best
    g leaves :math:`-R (1 - R)\, \theta`, and a simulation has noise of variance
    :math:`R (1 - R)`: the ratio is :math:`\sqrt{R (1 - R)} \le 1/2`.
    """
    found = dependence(residuals, theta)
    spread = float(simulations.embedded.var(dim=0).sum())
    noise = float(simulations.noise.trace())
    unit = max(noise, SMALLEST_SHARE**2 * spread) ** 0.5
    lower = max(found.bias - 1.645 * found.error, 0.0)
    value = lower / unit if unit else float(lower > 0)
    significant = found.p_value < LEVEL
    alarming = significant and value > LARGEST_RATIO
    if alarming:
        sentence = (
            "What tuning leaves of the calibration pairs depends on their parameters: "
            f"a bias of at least {value:.2f} times the simulator's noise (p = "
            f"{found.p_value:.3f}). Tuning has not generalised, for want of pairs or "
            "of training, or real observations do not follow the parameters as "
            "simulations do, and the conditional independence RoPE rests on fails."
        )
    else:
        sentence = (
            "What tuning leaves of the calibration pairs depends on their parameters "
            f"by {found.bias / unit if unit else 0.0:.2f} times the simulator's noise "
            f"(p = {found.p_value:.3f}), "
            + ("as it does where all is well." if significant else "if at all.")
        )
    return Finding(
        name="residual depends on parameters",
        value=value,
        threshold=LARGEST_RATIO,
        alarming=alarming,
        sentence=sentence,
        reason=(
            "Alarming above the threshold (the lower 95 % limit of the ratio), if p is "
            "below 0.01: averaging over the "
            "simulator's noise alone leaves up to half of it in a linear-Gaussian "
            "problem."
        ),
    )
