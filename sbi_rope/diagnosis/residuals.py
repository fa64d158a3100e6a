"""Test whether the residuals of calibration pairs depend on their parameters."""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.data.pairs import Pairs, one_of_each_group, without_warning_of_few_pairs
from sbi_rope.data.simulate import targets
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations
from sbi_rope.metrics.statistics import LEVEL, permutation_test
from sbi_rope.npe.sbi import embed
from sbi_rope.rope.rope import RoPE
from sbi_rope.utils.tensors import divisors

NAME = "residual depends on parameters"
# Averaging over the simulator's noise explains at most this, see `bias_finding`.
LARGEST_RATIO = 0.5
# Without noise, a bias is measured in units of this share of the embeddings' spread.
SMALLEST_SHARE = 0.05


class HeldOut(NamedTuple):
    r"""Pairs embedded by nets g that were not trained on them, and their targets.

    ``embedded`` is :math:`g(x)`, and ``targets`` :math:`E[h(S(\theta))]`, ``(n_c, l)``.
    Pairs of one ``group``, ``(n_c,)``, are not independent: their errors are alike.
    """

    embedded: Tensor
    targets: Tensor
    group: Tensor

    def mean_of_groups(self, values: Tensor) -> Tensor:
        """Return the mean of each group of values of the pairs, ``(n_c, ...)``."""
        member = (self.group.unique()[:, None] == self.group).to(values)
        return torch.tensordot(member / member.sum(dim=1, keepdim=True), values, dims=1)


def num_features(num_pairs: int, dim: int) -> int:
    """Return how many features of the parameters to regress on; 0 if pairs are few."""
    return next((p for p in (2 * dim, dim) if num_pairs >= 2 * (p + 1) + 2), 0)


def cross_fit(rope: RoPE, *, num_folds: int, show_progress_bars: bool) -> HeldOut:
    r"""Embed each calibration pair by a g that was trained on the other folds.

    Where labels are not exact, g is tuned to averages given the label alone, other than
    by :meth:`RoPE.train`: residuals from averages that are also given x would be too
    small, as they would be of pairs that g was trained on.
    """
    pairs, h, finetuner = rope.pairs, rope.npe.h, rope.finetuner
    of_pairs = targets(
        rope.source,
        pairs,
        finetuner.simulations_per_target,
        partial(embed, h),
        num_neighbors=finetuner.num_neighbors,
    )
    # Recordings of one person share a fold, as they do in a stack.
    folds = pairs.folds(num_folds)
    others = [
        torch.cat([fold for fold in folds if fold is not held_out])
        for held_out in folds
    ]
    with without_warning_of_few_pairs():
        nets, _ = finetuner.tuned(
            h,
            pairs.x,
            [of_pairs] * len(folds),
            others,
            groups=pairs.group,
            weights=pairs.weight,
            draw_simulations=lambda n: rope.source.from_prior(n, seed=0)[1],
            show_progress_bars=show_progress_bars,
        )
    embedded = torch.empty_like(of_pairs)
    for number, held_out in enumerate(folds):
        embedded[held_out] = embed(nets.member(number), pairs.x[held_out])
    return HeldOut(
        embedded=embedded.cpu().double(),
        targets=of_pairs.cpu().double(),
        group=pairs.group.cpu(),
    )


def dependence(residuals: Tensor, theta: Tensor) -> tuple[float, float, float]:
    r"""Regress residuals ``(n, l)`` on parameters ``(n, d)`` and their squares.

    With p features that explain a sum of squares, and residual variance :math:`s^2`,
    the bias b is estimated by :math:`b^2 = (\text{explained} - p\, s^2) / n`, which is
    unbiased. If pairs are few, the squares of the parameters are left out. The standard
    error of b is at most about :math:`\sqrt{(s^2 + b^2 / 2) / n}`, its value if all
    residual variance has the direction of the bias.

    Returns:
        The p-value of a permutation test, b, and its standard error.
    """
    count = num_features(*theta.shape)
    standard = (theta - theta.mean(dim=0)) / divisors(theta.std(dim=0))
    features = torch.cat([standard, standard.square()], dim=1)[:, :count]
    found = permutation_test(residuals, features)
    n, p = len(residuals), found.num_features
    total = float((residuals - residuals.mean(dim=0)).square().sum())
    variance = (total - found.explained) / (n - 1 - p)
    square = max(found.explained - p * variance, 0.0) / n
    return found.p_value, square**0.5, ((variance + square / 2) / n) ** 0.5


def residual_finding(
    pairs: Pairs, held_out: HeldOut | None, simulations: Simulations
) -> Finding:
    """Say whether residuals of the pairs depend on their parameters."""
    if not num_features(pairs.num_groups, pairs.theta.shape[-1]):
        few = f"{pairs.num_groups} different labels (or groups) are too few"
        return Finding(NAME, f"Not tested, because {few}.")
    if held_out is None:
        return Finding(NAME, "Not tested, because `num_folds` is None.")
    theta = pairs.mean.detach().cpu().double()
    residuals = held_out.embedded - held_out.targets
    labels = torch.stack([pairs.group, pairs.label.group]).unique(dim=1)
    if labels.shape[1] > pairs.num_groups:
        # The mean over parameters that differ would depend on them less.
        chosen = one_of_each_group(held_out.group, seed=0)
        theta, residuals = theta[chosen], residuals[chosen]
    else:
        theta, residuals = map(held_out.mean_of_groups, (theta, residuals))
    return bias_finding(residuals, theta, simulations)


def bias_finding(residuals: Tensor, theta: Tensor, simulations: Simulations) -> Finding:
    r"""Return a finding about the bias, its lower 95 % limit, in units of the noise.

    Residuals depend on the parameters even if nothing is wrong. Let :math:`h` be the
    posterior mean of a linear-Gaussian problem that explains a share R of the variance.
    The residuals of the best g are then :math:`-R (1 - R)\, \theta`, and the noise of
    simulations has the variance :math:`R (1 - R)`. The ratio is
    :math:`\sqrt{R (1 - R)} \le 1/2`.
    """
    p_value, bias, error = dependence(residuals, theta)
    spread = float(simulations.embedded.var(dim=0).sum())
    noise = float(simulations.noise.trace())
    unit = max(noise, SMALLEST_SHARE**2 * spread) ** 0.5 or 1.0
    value = max(bias - 1.645 * error, 0.0) / unit
    alarming = p_value < LEVEL and value > LARGEST_RATIO
    sentence = (
        f"The bias that depends on the parameters is at least {value:.2g} times the "
        f"simulator's noise (p = {p_value:.2g}); averaging over noise gives up to "
        f"{LARGEST_RATIO}."
    )
    if alarming:
        sentence += (
            " Either there are too few pairs for tuning, or real observations do not "
            "follow the parameters as simulations do, which RoPE assumes. Append more "
            "pairs, or use `stack`, which does not assume it."
        )
    return Finding(NAME, sentence, alarming, value, LARGEST_RATIO)
