"""Score the candidates of a stack, and the stack itself, on the folds held out."""

from collections.abc import Sequence

import torch
from torch import Tensor

from sbi_rope.data.pairs import Pairs, groups_of, one_of_each_group
from sbi_rope.density import Density, MixturePosterior
from sbi_rope.density.base import without_nan
from sbi_rope.density.sets import SetScores, joint_scores, marginal_scores
from sbi_rope.metrics import Evaluation, draw_samples
from sbi_rope.metrics.evaluation import estimates_and_ranks
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.data import StackData
from sbi_rope.stacking.posterior import fold_posterior
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.weights import fold_weights, stacking_weights
from sbi_rope.utils.errors import SamplingError
from sbi_rope.utils.seeds import seeded

# Samples at each held-out pair, from which the calibration of the stack is computed.
NUM_SAMPLES = 250
# Nodes at which the density of a label is computed that is not exact.
NUM_NODES = 512


@torch.no_grad()
def score_folds(
    data: StackData,
    candidates: Sequence[Candidate],
    fitted: Sequence[Sequence[Density]],
    *,
    seed: int,
) -> StackingReport:
    """Score what was trained without each fold on the pairs of the fold.

    Args:
        data: The pairs and their folds.
        candidates: What the columns of the scores are called.
        fitted: The densities of each candidate, of which number k has not seen fold k.
        seed: Seed of the draws at the held-out pairs.
    """
    pairs, weight = data.pairs, data.pairs.shared_weight
    of_folds = [*zip(*(one[: len(data.folds)] for one in fitted), strict=True)]
    log_scores = weight.new_empty(len(data), len(fitted))
    fold = torch.empty_like(pairs.group)
    at_labels = []
    for k, (rows, densities) in enumerate(zip(data.folds, of_folds, strict=True)):
        # Nodes come from the samples of each candidate, so that none is scored at
        # parameters that only others consider plausible.
        nodes, x = data.nodes(rows, densities, NUM_NODES), pairs.x[rows]
        theta = nodes.theta.movedim(1, 0)
        log_q = [without_nan(one.log_prob(theta, x)).double().T for one in densities]
        at_labels.append((nodes, torch.stack(log_q, dim=2)))
        fold[rows], log_scores[rows] = k, nodes.log_mean(at_labels[k][1])
    weights = fold_weights(log_scores, fold, weight)
    parts = []
    for k, (rows, (nodes, log_q)) in enumerate(zip(data.folds, at_labels, strict=True)):
        own, x = weights[k], pairs.x[rows]
        posterior = fold_posterior(of_folds[k], own, data.prior)
        log_prob = nodes.log_mean((log_q + own.log()).logsumexp(dim=2))
        try:
            log_mass = posterior.leakage_correction(x).double().log()
            drawn = scores_of_draws(posterior, pairs[rows], seed=seed)
        except SamplingError as error:
            raise SamplingError(
                "The stack has almost no mass inside the support of the prior at a "
                "held-out observation; add the prior to the candidates."
            ) from error
        parts.append((log_prob - log_mass, *drawn))
    order = torch.cat(data.folds).argsort()
    log_prob, estimates, ranks, joint, marginal = (
        torch.cat(column)[order] for column in zip(*parts, strict=True)
    )
    set_scores, rows = None, pairs.is_exact.nonzero().flatten()
    if len(rows):  # for sets with a guarantee, one of each group counts
        groups = groups_of(pairs.group[rows])
        rows = rows[one_of_each_group(groups, seed=seed).to(rows.device)]
        set_scores = SetScores(
            joint=joint[rows],
            marginal=marginal[rows],
            fold=fold[rows],
            weights=weights,
            num_draws=NUM_SAMPLES,
        )
    are_plain = pairs.are_exact and bool((pairs.weight == 1).all())
    return StackingReport(
        names=tuple(candidate.name for candidate in candidates),
        weights=stacking_weights(log_scores, pair_weights=weight),
        log_scores=log_scores,
        comparable_scores=(log_scores + weights[fold].log()).logsumexp(dim=1),
        fold=fold,
        held_out=Evaluation(
            log_prob=log_prob,
            ranks=ranks,
            estimates=estimates,
            log_unit=_log_unit(data),
            weight=weight,
            group=pairs.group if pairs.num_groups < len(pairs) else None,
            parameter_names=data.npe.parameter_names,
        ),
        set_scores=set_scores,
        labels="" if are_plain else str(pairs),
        are_exact=pairs.are_exact,
    )


@torch.no_grad()
def scores_of_draws(
    posterior: MixturePosterior, pairs: Pairs, *, seed: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return estimates, ranks, and the joint and marginal scores of sets at labels.

    Draws of the posterior get the noise of a label, so that its ranks are uniform if
    the posterior is calibrated. They test it less the larger the noise is. Ranks are
    NaN for parameters that were not measured, and for labels given as draws.
    Scores of sets are NaN where a label is not exact: a set that holds a label need not
    hold the parameters.
    """
    x, y, std = pairs.x, pairs.y, pairs.std.nan_to_num()
    joint = torch.full((len(x),), torch.nan, dtype=torch.double, device=x.device)
    marginal = torch.full_like(std, torch.nan)
    with seeded(seed):
        draws = draw_samples(posterior, x, num_samples=NUM_SAMPLES)
        noise = std.to(draws) * torch.randn_like(draws) if std.any() else 0.0
        estimates, ranks = estimates_and_ranks(draws + noise, y)
    if (exact := pairs.is_exact).any():
        theta, draws = y[exact], draws[:, exact]
        both = torch.cat([theta[None], draws])
        log_probs = posterior.log_prob_batched(both, x[exact]).T
        joint[exact] = joint_scores(log_probs[:, :1], log_probs[:, 1:])[:, 0]
        columns = draws.permute(1, 2, 0)
        marginal[exact] = marginal_scores(theta[..., None], columns)[..., 0]
    ranks = ranks.to(y).where(pairs.is_measured, torch.nan)
    return estimates.to(y), ranks, joint, marginal


def _log_unit(data: StackData) -> float | Tensor:
    """Return by how much scores are higher in the prior's standard deviations."""
    if data.pairs.are_drawn:
        return 0.0  # these scores are relative to the prior
    units = data.prior.log_units()
    return data.pairs.is_measured.to(units) @ units
