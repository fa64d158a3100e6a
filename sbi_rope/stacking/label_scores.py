"""The scores of candidates at labels that are not exact."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._labels import Labels, Nodes, Reference, nodes_of, reference_of
from sbi_rope._random import seeded
from sbi_rope.metrics.by_estimate import estimates_and_ranks
from sbi_rope.metrics.calibration import central_levels, count_ranks
from sbi_rope.metrics.calls import draw_samples
from sbi_rope.mixture import MixtureEstimator, MixturePosterior
from sbi_rope.stacking.held_out import FoldScores, explained, score_fold
from sbi_rope.stacking.versions import Versions
from sbi_rope.stacking.workbench import Workbench

__all__ = ["LabelScores", "label_levels", "score_labelled_fold", "score_labels"]

# Samples of each candidate at each observation, from which nodes are placed.
NUM_SAMPLES = 200
# Nodes of each label. Couplings have a density for each simulation at each node.
NUM_NODES, NUM_NODES_OF_COUPLINGS = 512, 128


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


def score_labels(bench: Workbench, versions: Versions, number: int) -> LabelScores:
    """Score all candidates on the labels of a fold that they were not trained on.

    Nodes come from the samples of each candidate, so that none is scored at parameters
    that only others consider plausible.

    Args:
        bench: What all candidates share.
        versions: The candidates.
        number: The number of the fold, and of the version.
    """
    rows = bench.folds[number]
    x, prior = bench.x[rows], bench.npe.prior
    coupled = versions.couplings is not None
    with seeded(bench.seed_of(frozenset([number]))):
        references = _references(versions, x, number)
        nodes = nodes_of(
            bench.labels[rows],
            references,
            prior,
            num_nodes=NUM_NODES_OF_COUPLINGS if coupled else NUM_NODES,
        )
    return LabelScores(
        nodes=nodes, log_q=versions.node_log_probs(nodes.theta, x, number)
    )


def _references(versions: Versions, x: Tensor, number: int) -> list[Reference]:
    estimators = list(versions.estimators(number).values())
    if versions.couplings is not None:
        estimators.append(MixtureEstimator([versions.couplings.part], [1.0]))
    size = torch.Size((NUM_SAMPLES,))
    return [reference_of(estimator.sample(size, x)) for estimator in estimators]


@torch.no_grad()
def score_labelled_fold(
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

    Args:
        posterior: A posterior that has not seen the labels.
        scores: The densities of its candidates at the labels.
        weights: The weights of the candidates, shape ``(K,)``.
        labels: The labels.
        x: Their observations, shape ``(n, *event)``.
        num_samples: The number of draws for each label.
        seed: Seed of the draws.

    Returns:
        The scores. Those of sets are NaN where a label is not exact: a set that holds
        a label need not hold the parameters.

    Raises:
        SamplingError: If the posterior has almost no mass inside the prior's support.
    """
    log_prob, errors = scores.of_stack(weights)
    with explained(), seeded(seed):
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
