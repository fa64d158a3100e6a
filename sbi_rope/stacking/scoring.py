"""Score the candidates of a stack, and the stack itself, on the folds held out."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from sbi_rope._groups import groups_of, one_of_each_group
from sbi_rope._labels import Labels, Nodes, nodes_of, reference_of
from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._units import log_units_of
from sbi_rope.errors import SamplingError, warn_user
from sbi_rope.metrics.by_estimate import estimates_and_ranks
from sbi_rope.metrics.calibration import central_levels, count_ranks, random_ranks
from sbi_rope.metrics.calls import draw_chunks, draw_samples
from sbi_rope.mixture import MixturePosterior
from sbi_rope.sets.conformal import joint_scores, marginal_scores
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.cross_validation import (
    CrossValidation,
    SetScores,
    fold_weights,
)
from sbi_rope.stacking.versions import Versions
from sbi_rope.stacking.workbench import Workbench

__all__ = ["FoldScores", "LabelScores", "label_levels", "score_fold", "score_versions"]

# Samples at each held-out pair, from which the calibration of the stack is computed,
# and for how many observations at a time they are drawn.
NUM_SAMPLES, MAX_OBSERVATIONS = 500, 500
# Of labels that are not exact: samples of each candidate at each observation, from
# which nodes are placed, and the nodes of each label.
NUM_REFERENCES, NUM_NODES = 200, 512


@dataclass(frozen=True, eq=False, kw_only=True)
class FoldScores:
    """Scores of a stack at held-out pairs.

    Attributes:
        log_prob: The log density, normalised inside the prior's support, ``(n,)``.
        levels: As in :class:`~sbi_rope.stacking.CrossValidation`, ``(n, d)``.
        estimates: As in :class:`~sbi_rope.stacking.CrossValidation`, ``(n, d)``.
        ranks: As in :class:`~sbi_rope.stacking.CrossValidation`, ``(n, d)``.
        joint: As in :class:`SetScores`.
        marginal: As in :class:`SetScores`.
        errors: The Monte-Carlo errors of ``log_prob``, zero for exact labels, ``(n,)``.
    """

    log_prob: Tensor
    levels: Tensor
    estimates: Tensor
    ranks: Tensor
    joint: Tensor
    marginal: Tensor
    errors: Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelScores:
    """The densities of candidates at the nodes of the labels of one fold.

    Attributes:
        nodes: The nodes.
        log_q: The log density of each candidate at the nodes, shape ``(n, S, K)``.
    """

    nodes: Nodes
    log_q: Tensor

    @property
    def of_candidates(self) -> Tensor:
        """The log density of each label under each candidate, shape ``(n, K)``."""
        return self.nodes.log_mean(self.log_q)

    def of_stack(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log density of each label under a mixture, and its error.

        Args:
            weights: The weights of the candidates, shape ``(K,)``.

        Returns:
            The log densities, not corrected for leakage, and their Monte-Carlo errors,
            both of shape ``(n,)``.
        """
        log_q = (self.log_q + weights.to(self.log_q).log()).logsumexp(dim=2)
        return self.nodes.log_mean(log_q), self.nodes.standard_error(log_q)


def score_versions(
    bench: Workbench,
    versions: Versions,
    candidates: Sequence[Candidate],
    *,
    num_training_folds: int,
    seed: int,
) -> CrossValidation:
    """Score what was trained without each fold on the pairs of the fold.

    Args:
        bench: The pairs and their folds.
        versions: The candidates, trained without each fold.
        candidates: What the columns of the scores are called.
        num_training_folds: The number of folds that each version was trained on.
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
            log_scores, fold, pair_weights=bench.labels.score_weights
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
    of_labels = None if bench.labels.are_exact else []
    for number, rows in enumerate(bench.folds):
        fold[rows] = number
        if of_labels is None:
            log_scores[rows] = versions.log_probs(theta[rows], x[rows], [number])
        else:
            of_labels.append(_score_labels(bench, versions, number))
            log_scores[rows] = of_labels[number].of_candidates
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

    Returns:
        The scores, their Monte-Carlo errors (zero for exact labels), and the levels of
        the central intervals that end at the labels.
    """
    theta, x = bench.theta, bench.x
    of_folds = []
    for number, rows in enumerate(bench.folds):
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
            scores = _score_labelled_fold(
                posterior,
                of_labels[number],
                weights[number],
                bench.labels[rows],
                x[rows],
                num_samples=NUM_SAMPLES,
                seed=seed,
            )
        of_folds.append(scores)
        advance()
    order = torch.cat(bench.folds).argsort()
    return FoldScores(
        **{
            entry.name: torch.cat([getattr(one, entry.name) for one in of_folds])[order]
            for entry in fields(FoldScores)
        }
    )


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


@torch.no_grad()
def score_fold(
    posterior: MixturePosterior,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int,
    seed: int,
) -> FoldScores:
    """Score the posterior of a fold at the pairs of the fold.

    Raises:
        SamplingError: If the posterior has almost no mass inside the prior's support.
    """
    log_prob, levels, joint, marginal, by_estimate = [], [], [], [], []
    with _explained(), seeded(seed):
        chunks = draw_chunks(
            posterior,
            theta,
            x,
            num_samples=num_samples,
            chunk_size=MAX_OBSERVATIONS,
            show=False,
        )
        for rows, draws in chunks:
            levels.append(central_levels(random_ranks(draws, theta[rows])))
            # In one call, because the mass inside the support is estimated in each.
            log_probs = posterior.log_prob_batched(
                torch.cat([theta[rows][None], draws]), x[rows]
            ).double()
            log_prob.append(log_probs[0])
            joint.append(joint_scores(log_probs[:1].T, log_probs[1:].T)[:, 0])
            columns = draws.permute(1, 2, 0)
            marginal.append(marginal_scores(theta[rows, :, None], columns)[..., 0])
            by_estimate.append(estimates_and_ranks(draws, theta[rows]))
    estimates, ranks = (torch.cat(parts) for parts in zip(*by_estimate, strict=True))
    return FoldScores(
        log_prob=torch.cat(log_prob),
        levels=torch.cat(levels).to(theta),
        estimates=estimates.to(theta),
        ranks=ranks.to(theta),
        joint=torch.cat(joint),
        marginal=torch.cat(marginal),
        errors=torch.zeros(len(theta), dtype=torch.double, device=theta.device),
    )


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Say what to do if a stack has hardly any mass inside the prior's support."""
    try:
        yield
    except SamplingError as error:
        raise SamplingError(
            "The stack has almost no mass inside the support of the prior at a "
            "held-out observation; add the prior to the candidates."
        ) from error


def _score_labels(bench: Workbench, versions: Versions, number: int) -> LabelScores:
    """Score all candidates on the labels of a fold that they were not trained on.

    Nodes come from the samples of each candidate, so that none is scored at parameters
    that only others consider plausible.
    """
    rows = bench.folds[number]
    x, size = bench.x[rows], torch.Size((NUM_REFERENCES,))
    with seeded(bench.seed_of(frozenset([number]))):
        samples = [one.sample(size, x) for one in versions.estimators(number)]
        nodes = nodes_of(
            bench.labels[rows],
            [reference_of(of_one) for of_one in samples],
            bench.npe.prior,
            num_nodes=NUM_NODES,
        )
    return LabelScores(
        nodes=nodes, log_q=versions.node_log_probs(nodes.theta, x, number)
    )


@torch.no_grad()
def _score_labelled_fold(
    posterior: MixturePosterior,
    scores: LabelScores,
    weights: Tensor,
    labels: Labels,
    x: Tensor,
    *,
    num_samples: int,
    seed: int,
) -> FoldScores:
    """Score the posterior of a fold at labels that are not exact.

    Returns:
        The scores. Those of sets are NaN where a label is not exact: a set that holds
        a label need not hold the parameters.

    Raises:
        SamplingError: If the posterior has almost no mass inside the prior's support.
    """
    log_prob, errors = scores.of_stack(weights)
    with _explained(), seeded(seed):
        log_mass = posterior.leakage_correction(x).double().log()
        levels, estimates, ranks = label_levels(
            posterior, labels, x, num_samples=num_samples
        )
    marginal = torch.full_like(labels.theta, torch.nan)
    joint = torch.full_like(log_prob, torch.nan)
    if (exact := labels.is_exact).any():
        known = score_fold(
            posterior, labels.theta[exact], x[exact], num_samples=num_samples, seed=seed
        )
        joint[exact], marginal[exact] = known.joint, known.marginal.to(marginal)
    return FoldScores(
        log_prob=log_prob - log_mass,
        levels=levels,
        estimates=estimates,
        ranks=ranks,
        joint=joint,
        marginal=marginal,
        errors=errors,
    )


def label_levels(
    posterior: MixturePosterior, labels: Labels, x: Tensor, *, num_samples: int
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return the levels of the central intervals of labels that end at them.

    For a noisy label this is the interval of the measurement, not of the parameter:
    draws of the posterior get the noise of the label. The levels are uniform if the
    posterior is calibrated, and their test of it is weaker the larger the noise is.

    Args:
        posterior: The posterior.
        labels: The labels.
        x: Their observations, shape ``(n, *event)``.
        num_samples: The number of draws for each observation.

    Returns:
        The levels, the means of the posterior and the ranks of the labels, each of
        shape ``(n, d)``. Levels and ranks are NaN for parameters that were not
        measured, and for labels given as draws.
    """
    unknown = torch.full_like(labels.theta, torch.nan)
    if labels.samples is not None:
        return unknown, unknown, unknown
    samples = draw_samples(posterior, x, num_samples=num_samples)
    std = labels.covariance.diagonal(dim1=1, dim2=2).sqrt().to(samples)
    measured = samples + std * torch.randn_like(samples)
    levels = central_levels(count_ranks(measured, labels.theta)).to(labels.theta)
    estimates, ranks = estimates_and_ranks(measured, labels.theta)
    return (
        levels.where(labels.is_measured, torch.nan),
        estimates.to(labels.theta),
        ranks.to(labels.theta).where(labels.is_measured, torch.nan),
    )
