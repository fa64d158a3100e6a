"""Recalibrate a stack by mixtures of versions that have not seen a fold.

The stack mixes several versions of each candidate, and a mixture is wider than its
members. So a single version that has not seen a fold does not tell how wide the stack
should be. Versions are therefore trained without two folds each. All those that have
not seen a fold are mixed, and this mixture is scored on the fold.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor

from sbi_rope._bounds import Bounds, bounds_of_prior
from sbi_rope._means import Counts
from sbi_rope._sbi import MixedDensity, estimator_of, headless
from sbi_rope.errors import InvalidInputError, UnsupportedPosteriorError
from sbi_rope.mixture import MixtureEstimator
from sbi_rope.recalibration import Recalibration
from sbi_rope.recalibration.estimator import RecalibratedEstimator
from sbi_rope.recalibration.factors import HeldOutMixture
from sbi_rope.recalibration.recalibration import recalibrate
from sbi_rope.stacking.versions import Versions
from sbi_rope.stacking.workbench import Workbench

__all__ = ["check_recalibration", "pairs_of_folds", "recalibrated", "recalibration_of"]

# Fewer folds cannot be left out in pairs, and fewer pairs say nothing about a spread.
MIN_FOLDS, MIN_PAIRS = 3, 10
# A fold is left out together with the folds that are so many places after it.
DISTANCES = (1, 2)


def check_recalibration(bench: Workbench) -> None:
    """Raise if the posterior of these pairs cannot be recalibrated."""
    if not bench.labels.are_exact:
        raise InvalidInputError(
            f"Expected exact labels to recalibrate; got {bench.labels}. Leave "
            "`recalibrate` out, or stack the exact labels alone."
        )
    if isinstance(headless(estimator_of(bench.npe)), MixedDensity):
        raise UnsupportedPosteriorError(
            "Expected continuous parameters to recalibrate; got some that are "
            "categories. Leave `recalibrate` out."
        )
    prior = bench.npe.prior
    usable = _say_something(bench.theta, prior, bounds_of_prior(prior)).cpu()
    if (count := len(bench.groups[usable].unique())) < MIN_PAIRS:
        raise InvalidInputError(
            f"Expected at least {MIN_PAIRS} calibration pairs with different "
            "parameters (or groups) to recalibrate, none of them on a bound of the "
            f"prior; got {count}. Add pairs, or leave `recalibrate` out."
        )
    if len(bench.folds) < MIN_FOLDS:
        raise InvalidInputError(
            f"Expected at least {MIN_FOLDS} folds to recalibrate; got "
            f"{len(bench.folds)}. Pass a larger `num_folds`."
        )


def pairs_of_folds(num_folds: int) -> list[frozenset[int]]:
    """Return the pairs of folds that are left out together.

    With up to five folds these are all pairs. With more folds each is left out with
    four others.

    Example:
        >>> [sorted(pair) for pair in pairs_of_folds(3)]
        [[0, 1], [0, 2], [1, 2]]
    """
    pairs = {
        frozenset((k, (k + distance) % num_folds))
        for k in range(num_folds)
        for distance in DISTANCES
    }
    return sorted(pairs, key=sorted)


def recalibration_of(
    bench: Workbench,
    versions: Versions,
    pairs: Sequence[frozenset[int]],
    weights: Tensor,
    *,
    seed: int,
) -> Recalibration:
    """Choose how much narrower or wider a stack has to be.

    Args:
        bench: The calibration pairs and their folds.
        versions: The candidates, in a version without each pair of folds.
        pairs: The pairs of folds.
        weights: The weights of the stack that scores each fold, shape ``(F, K)``.
        seed: Seed of the draws.
    """
    prior = bench.npe.prior
    bounds = bounds_of_prior(prior)
    folds, kept = [], []
    for number, rows in enumerate(bench.folds):
        theta = bench.theta[rows]
        inside = _say_something(theta, prior, bounds)
        if not inside.any():
            continue
        unseen = [k for k, pair in enumerate(pairs) if number in pair]
        mixture = versions.estimator(weights[number], unseen)
        folds.append(
            HeldOutMixture(
                estimator=RecalibratedEstimator(
                    mixture, torch.ones_like(bounds.low), bounds
                ),
                theta=theta[inside],
                x=bench.x[rows][inside],
                accept=None if bounds.are_all else partial(within_support, prior),
            )
        )
        kept.append(rows[inside])
    return recalibrate(folds, _counts(bench)[torch.cat(kept)], seed=seed)


def recalibrated(
    mixture: MixtureEstimator, recalibration: Recalibration | None, prior: Any
) -> MixtureEstimator:
    """Return a mixture with the factors of a recalibration, if there are any."""
    if recalibration is None or not recalibration.is_used:
        return mixture
    return RecalibratedEstimator(mixture, recalibration.factors, bounds_of_prior(prior))


def _say_something(theta: Tensor, prior: Any, bounds: Bounds) -> Tensor:
    """Return whether each of some parameters ``(n, d)`` says something about a spread.

    Those outside the prior's support do not. On a bound, the density with another
    spread is zero or infinite.
    """
    return within_support(prior, theta) & bounds.hold(theta)


def _counts(bench: Workbench) -> Counts:
    weights = bench.labels.score_weights
    if weights is None:
        weights = torch.ones(len(bench.theta), device=bench.theta.device)
    return Counts(weights.double(), bench.labels.shared_groups)
