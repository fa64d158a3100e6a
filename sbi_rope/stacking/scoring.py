"""Score the candidates of a stack, and the stack itself, on the folds held out."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.data.labels import nodes_of, reference_of
from sbi_rope.data.pairs import Labels, Nodes, groups_of, one_of_each_group
from sbi_rope.density import Density, Mixture, MixturePosterior
from sbi_rope.density.base import without_nan
from sbi_rope.density.sets import SetScores, joint_scores, marginal_scores
from sbi_rope.metrics import Evaluation, draw_samples
from sbi_rope.metrics.calls import draw_chunks
from sbi_rope.metrics.evaluation import estimates_and_ranks
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.data import StackData
from sbi_rope.stacking.posterior import fold_posterior
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.weights import fold_weights
from sbi_rope.utils.errors import SamplingError, warn_user
from sbi_rope.utils.seeds import seeded

# Samples at each held-out pair, from which the calibration of the stack is computed,
# and for how many observations at a time they are drawn.
NUM_SAMPLES, MAX_OBSERVATIONS = 250, 500
# Of labels that are not exact: samples of each candidate at each observation, from
# which nodes are placed, and the nodes of each label.
NUM_REFERENCES, NUM_NODES = 200, 512


class FoldScores(NamedTuple):
    """Scores of a stack at hold-out pairs, as in ``Evaluation`` and ``SetScores``.

    ``log_prob`` is normalised inside the prior's support. Its Monte-Carlo ``errors``
    are zero for exact labels.
    """

    log_prob: Tensor
    estimates: Tensor
    ranks: Tensor
    joint: Tensor
    marginal: Tensor
    errors: Tensor


@dataclass(frozen=True, eq=False)
class LabelScores:
    """The densities of K candidates at the nodes of labels, ``(n, S, K)``."""

    nodes: Nodes
    log_q: Tensor

    def of_stack(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log density of each label under a mixture, and its error.

        They are not corrected for leakage. Both have the shape ``(n,)``.
        """
        log_q = (self.log_q + weights.to(self.log_q).log()).logsumexp(dim=2)
        return self.nodes.log_mean(log_q), self.nodes.standard_error(log_q)


def score_folds(
    data: StackData,
    candidates: Sequence[Candidate],
    fitted: Sequence[Sequence[Density]],
    *,
    num_training_folds: int,
    seed: int,
) -> StackingReport:
    """Score what was trained without each fold on the pairs of the fold.

    Args:
        data: The pairs and their folds.
        candidates: What the columns of the scores are called.
        fitted: The densities of each candidate, of which number k has not seen fold k.
        num_training_folds: The number of folds that each was trained on.
        seed: Seed of the draws at the held-out pairs.
    """
    pairs, weight = data.pairs, data.pairs.shared_weight
    of_folds = [[one[k] for one in fitted] for k in range(len(data.folds))]
    log_scores = weight.new_empty(len(data), len(fitted))
    fold = torch.empty_like(pairs.group)
    of_labels = [_at_labels(data, of_one, k) for k, of_one in enumerate(of_folds)]
    for k, rows in enumerate(data.folds):
        fold[rows], log_scores[rows] = (
            k,
            of_labels[k].nodes.log_mean(of_labels[k].log_q),
        )
    weights = fold_weights(log_scores, fold, weight)
    of_stacks = [
        _score_fold(data, of_folds[k], weights[k], of_labels[k], k, seed=seed)
        for k in range(len(data.folds))
    ]
    order = torch.cat(data.folds).argsort()
    of_stack = FoldScores(
        *(torch.cat(parts)[order] for parts in zip(*of_stacks, strict=True))
    )
    is_simple = pairs.are_exact and bool((pairs.weight == 1).all())
    report = StackingReport(
        names=tuple(candidate.name for candidate in candidates),
        families=tuple(one.family or one.name for one in candidates),
        log_scores=log_scores,
        fold=fold,
        num_trained_on=len(fold) * num_training_folds // len(data.folds),
        held_out=Evaluation(
            log_prob=of_stack.log_prob,
            ranks=of_stack.ranks,
            estimates=of_stack.estimates,
            log_unit=_log_unit(data),
            weight=weight,
            group=pairs.group if pairs.num_groups < len(pairs) else None,
            parameter_names=data.npe.parameter_names,
        ),
        set_scores=_set_scores(data, of_stack, fold, weights, seed=seed),
        score_errors=None if pairs.are_exact else of_stack.errors,
        labels="" if is_simple else str(pairs),
    )
    if not report.weights.converged:
        warn_user(
            "The weights of the stack have not converged: the out-of-fold score could "
            f"be better by up to {report.weights.gap / float(weight.sum()):.3f} nats a "
            "pair. Leave out candidates that are nearly the same."
        )
    return report


def _score_fold(
    data: StackData,
    densities: Sequence[Density],
    weights: Tensor,
    of_labels: LabelScores,
    number: int,
    *,
    seed: int,
) -> FoldScores:
    """Score the stack that has not seen a fold at the pairs of the fold."""
    rows = data.folds[number]
    x, labels = data.pairs.x[rows], data.pairs.label[rows]
    posterior = fold_posterior(Mixture(densities, weights), data.prior)
    with _explained():
        if data.pairs.are_exact:
            return _score_exact(posterior, data.pairs.mean[rows], x, seed=seed)
        scores = of_labels.of_stack(weights)
        return _score_labels(posterior, scores, labels, x, seed=seed)


def _set_scores(
    data: StackData, of_stack: FoldScores, fold: Tensor, weights: Tensor, *, seed: int
) -> SetScores | None:
    """Return what sets with a guarantee are made from; None without exact labels.

    Labels that are not exact do not count: a set that holds a noisy label need not hold
    the parameters.
    """
    is_counted = data.pairs.label.is_exact.cpu()
    if not is_counted.any():
        return None
    groups = groups_of(data.pairs.group.cpu()[is_counted])
    is_counted[is_counted.clone()] = one_of_each_group(groups, seed=seed)
    rows = is_counted.to(fold.device)
    return SetScores(
        joint=of_stack.joint[rows],
        marginal=of_stack.marginal[rows],
        fold=fold[rows],
        weights=weights,
        num_draws=NUM_SAMPLES,
    )


def _log_unit(data: StackData) -> float | Tensor:
    """Return by how much scores are higher in the prior's standard deviations."""
    labels = data.pairs.label
    if labels.are_drawn:
        return 0.0  # these scores are relative to the prior
    units = data.prior.log_units()
    if labels.are_exact:
        return float(units.sum())
    return labels.is_measured.to(units) @ units


@torch.no_grad()
def _score_exact(
    posterior: MixturePosterior, theta: Tensor, x: Tensor, *, seed: int
) -> FoldScores:
    """Score the posterior of a fold at labels that are exact."""
    log_prob, joint, marginal, found = [], [], [], []
    with seeded(seed):
        chunks = draw_chunks(
            posterior,
            theta,
            x,
            num_samples=NUM_SAMPLES,
            chunk_size=MAX_OBSERVATIONS,
            show=False,
        )
        for rows, draws in chunks:
            # In one call, because the mass inside the support is estimated in each.
            log_probs = posterior.log_prob_batched(
                torch.cat([theta[rows][None], draws]), x[rows]
            ).double()
            log_prob.append(log_probs[0])
            joint.append(joint_scores(log_probs[:1].T, log_probs[1:].T)[:, 0])
            columns = draws.permute(1, 2, 0)
            marginal.append(marginal_scores(theta[rows, :, None], columns)[..., 0])
            found.append(estimates_and_ranks(draws, theta[rows]))
    estimates, ranks = (torch.cat(parts) for parts in zip(*found, strict=True))
    return FoldScores(
        log_prob=torch.cat(log_prob),
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


@torch.no_grad()
def _at_labels(
    data: StackData, densities: Sequence[Density], number: int
) -> LabelScores:
    """Return the densities of all candidates at the labels of a fold.

    Nodes come from the samples of each candidate, so that none is scored at parameters
    that only others consider plausible.
    """
    rows = data.folds[number]
    x, nodes = data.pairs.x[rows], Nodes.exact(data.pairs.mean[rows])
    if not data.pairs.are_exact:
        size = torch.Size((NUM_REFERENCES,))
        with seeded(data.seed_of(rows)):
            nodes = nodes_of(
                data.pairs.label[rows],
                [reference_of(one.sample(size, x)) for one in densities],
                data.prior,
                num_nodes=NUM_NODES,
            )
    theta = nodes.theta.movedim(1, 0)
    log_q = [without_nan(one.log_prob(theta, x)).double().T for one in densities]
    return LabelScores(nodes, torch.stack(log_q, dim=2))


@torch.no_grad()
def _score_labels(
    posterior: MixturePosterior,
    scores: tuple[Tensor, Tensor],
    labels: Labels,
    x: Tensor,
    *,
    seed: int,
) -> FoldScores:
    """Score the posterior of a fold at labels that are not all exact.

    Draws of the posterior get the noise of a label, so that its ranks are uniform if
    the posterior is calibrated. They test it less the larger the noise is. Ranks are
    NaN for parameters that were not measured, and for labels given as draws.
    Scores of sets are NaN where a label is not exact: a set that holds a label need not
    hold the parameters.
    """
    log_prob, errors = scores
    log_mass = posterior.leakage_correction(x).double().log()
    std = labels.covariance.diagonal(dim1=1, dim2=2).sqrt()
    with seeded(seed):
        samples = draw_samples(posterior, x, num_samples=NUM_SAMPLES)
        measured = samples + std.to(samples) * torch.randn_like(samples)
    known = labels.is_measured & (not labels.are_drawn)
    estimates, ranks = estimates_and_ranks(measured, labels.y)
    marginal = torch.full_like(labels.y, torch.nan)
    joint = torch.full_like(log_prob, torch.nan)
    if (exact := labels.is_exact).any():
        at_exact = _score_exact(posterior, labels.y[exact], x[exact], seed=seed)
        joint[exact], marginal[exact] = at_exact.joint, at_exact.marginal.to(marginal)
    return FoldScores(
        log_prob=log_prob - log_mass,
        estimates=estimates.to(labels.y),
        ranks=ranks.to(labels.y).where(known, torch.nan),
        joint=joint,
        marginal=marginal,
        errors=errors,
    )
