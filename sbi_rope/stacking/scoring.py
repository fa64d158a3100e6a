"""Score the candidates of a stack, and the stack itself, on the folds held out."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sbi_rope._groups import groups_of, one_of_each_group
from sbi_rope._progress import progress_bar
from sbi_rope._units import log_units_of
from sbi_rope.errors import warn_user
from sbi_rope.mixture import MixturePosterior
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.cross_validation import CrossValidation, fold_weights
from sbi_rope.stacking.held_out import FoldScores, SetScores, joined, score_fold
from sbi_rope.stacking.label_scores import (
    LabelScores,
    score_labelled_fold,
    score_labels,
)
from sbi_rope.stacking.versions import Versions
from sbi_rope.stacking.workbench import Workbench

__all__ = ["score_versions"]

# Samples at each held-out pair, from which the calibration of the stack is computed.
NUM_SAMPLES = 500


def score_versions(
    bench: Workbench,
    versions: Versions,
    candidates: Sequence[Candidate],
    *,
    num_training_folds: int,
    pseudo_count: float,
    seed: int,
) -> CrossValidation:
    """Score what was trained without each fold on the pairs of the fold.

    Args:
        bench: The pairs and their folds.
        versions: The candidates, trained without each fold.
        candidates: What the columns of the scores are called.
        num_training_folds: The number of folds that each version was trained on.
        pseudo_count: The strength of the prior of the weights.
        seed: Seed of the draws at the held-out pairs.
    """
    # Samples of a flow can take longer than its training did.
    with progress_bar(
        show=bench.show,
        desc=f"Scoring the candidates and the stack on {len(bench.folds)} folds",
        total=2 * len(bench.folds),
    ) as bar:
        of_labels, log_scores, fold = _log_scores(bench, versions, bar.update)
        weights = fold_weights(
            log_scores, fold, pseudo_count, pair_weights=bench.labels.score_weights
        )
        of_stack = _stack_scores(
            bench, versions, weights, of_labels, seed=seed, advance=bar.update
        )
    scores = CrossValidation(
        names=tuple(candidate.name for candidate in candidates),
        families=tuple(candidate.family for candidate in candidates),
        log_scores=log_scores,
        fold=fold,
        num_trained_on=len(fold) * num_training_folds // len(bench.folds),
        stack_scores=of_stack.log_prob,
        levels=of_stack.levels,
        estimates=of_stack.estimates,
        ranks=of_stack.ranks,
        set_scores=_set_scores(bench, of_stack, weights, seed=seed),
        pseudo_count=pseudo_count,
        log_unit=_log_unit(bench),
        pair_weights=bench.labels.score_weights,
        groups=bench.labels.shared_groups,
        score_errors=None if bench.labels.are_exact else of_stack.errors,
        labels="" if bench.labels.are_simple else str(bench.labels),
    )
    if not scores.weights.converged:
        counted = bench.labels.score_weights
        total = len(fold) if counted is None else float(counted.sum())
        warn_user(
            "The weights of the stack have not converged: the held-out score could "
            f"be better by up to {scores.weights.gap / total:.3f} nats a "
            "pair. Leave out candidates that are nearly the same."
        )
    return scores


def _log_scores(
    bench: Workbench, versions: Versions, advance: Callable[[], Any]
) -> tuple[list[LabelScores] | None, Tensor, Tensor]:
    """Return the score of each candidate at each pair, and the folds.

    The first entry has the densities at labels that are not exact. It is None if all
    are.
    """
    theta, x = bench.theta, bench.x
    log_scores = theta.new_empty(len(theta), len(versions.names), dtype=torch.double)
    fold = torch.empty(len(theta), dtype=torch.long, device=theta.device)
    log_q, of_labels = None, None if bench.labels.are_exact else []
    if versions.couplings is not None and of_labels is None:
        # All folds share the same simulations, and so the same components.
        log_q = versions.couplings.component_log_probs(theta)
    for number, rows in enumerate(bench.folds):
        fold[rows] = number
        if of_labels is not None:
            of_labels.append(score_labels(bench, versions, number))
            log_scores[rows] = of_labels[number].of_candidates
        else:
            log_scores[rows] = versions.log_probs(
                theta[rows],
                x[rows],
                [number],
                log_q=None if log_q is None else log_q[rows],
            )
        advance()
    return of_labels, log_scores, fold


def _stack_scores(
    bench: Workbench,
    versions: Versions,
    weights: Tensor,
    of_labels: Sequence[LabelScores] | None,
    *,
    seed: int,
    advance: Callable[[], Any],
) -> FoldScores:
    """Return the scores of the stack at each pair, normalised in the support.

    Args:
        bench: The pairs and their folds.
        versions: The candidates.
        weights: The weights of the stack that scores each fold, ``(F, K)``.
        of_labels: The densities at labels that are not exact; None if all are.
        seed: Seed of the draws.
        advance: Called after each fold, for a progress bar.

    Returns:
        The scores, their Monte-Carlo errors (zero for exact labels), and the levels of
        the central intervals that end at the labels.
    """
    theta, x = bench.theta, bench.x
    # The couplings are the first part, and have the same simulations in all folds. The
    # mass of the other parts inside the prior can differ from fold to fold.
    masses: dict[int, Tensor] = {}
    of_folds = []
    for number, rows in enumerate(bench.folds):
        shared = dict(masses)
        posterior = MixturePosterior(
            versions.estimator(weights[number], [number]),
            bench.npe.prior,
            enable_transform=False,
            warns=False,
        )
        if of_labels is None:
            scores = score_fold(
                posterior, theta[rows], x[rows], num_samples=NUM_SAMPLES, seed=seed
            )
        else:
            scores = score_labelled_fold(
                posterior,
                of_labels[number],
                weights[number],
                bench.labels[rows],
                x[rows],
                num_samples=NUM_SAMPLES,
                seed=seed,
            )
        of_folds.append(scores)
        if versions.couplings is not None and 0 in shared:
            masses[0] = shared[0]
        advance()
    return joined(of_folds, bench.folds)


def _set_scores(
    bench: Workbench, of_stack: FoldScores, weights: Tensor, *, seed: int
) -> SetScores | None:
    """Return what sets with a guarantee are made from; None without exact labels.

    Labels that are not exact do not count: a set that holds a noisy label need not hold
    the parameters.
    """
    is_counted = bench.labels.is_exact.cpu()
    if not is_counted.any():
        return None
    groups = groups_of(bench.groups[is_counted])
    is_counted[is_counted.clone()] = one_of_each_group(groups, seed=seed)
    return SetScores(
        joint=of_stack.joint,
        marginal=of_stack.marginal,
        is_counted=is_counted.to(bench.theta.device),
        weights=weights,
        num_draws=NUM_SAMPLES,
    )


def _log_unit(bench: Workbench) -> float | Tensor:
    """Return by how much scores are higher in the prior's standard deviations."""
    labels = bench.labels
    if labels.samples is not None:
        return 0.0  # these scores are relative to the prior
    units = log_units_of(bench.npe.prior)
    if labels.are_exact:
        return float(units.sum())
    return labels.is_measured.to(units) @ units
