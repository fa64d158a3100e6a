"""The scores of a stack at pairs that it has not seen."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.errors import SamplingError
from sbi_rope.metrics.by_estimate import estimates_and_ranks
from sbi_rope.metrics.calibration import central_levels, random_ranks
from sbi_rope.metrics.calls import draw_chunks
from sbi_rope.mixture import MixturePosterior
from sbi_rope.sets.conformal import (
    check_enough,
    joint_scores,
    marginal_scores,
    rank_needed,
)

__all__ = [
    "FoldScores",
    "SetScores",
    "explained",
    "joined",
    "score_fold",
]

# So many observations are drawn at a time.
MAX_OBSERVATIONS = 500


@dataclass(frozen=True, eq=False, kw_only=True)
class SetScores:
    """The held-out scores that sets with a guarantee are made from.

    Attributes:
        joint: The level of the smallest set of highest density that contains the true
            parameters, shape ``(n,)``. It is above 1 if their density is lower than
            that of all draws, see :func:`sbi_rope.sets.conformal.joint_scores`.
        marginal: The level of the smallest central interval of each parameter that
            contains the true one, shape ``(n, d)``. It is above 1 beyond all draws, see
            :func:`sbi_rope.sets.conformal.marginal_scores`.
        is_counted: The pairs that count, shape ``(n,)``. Those of one group are not
            exchangeable one by one. One of them counts, chosen at random. Pairs whose
            label is not exact do not count, and their scores are NaN.
        weights: The weights of the stack that scored each fold, shape ``(F, K)``.
        num_draws: The number of draws that the scores were computed from.
    """

    joint: Tensor
    marginal: Tensor
    is_counted: Tensor
    weights: Tensor
    num_draws: int

    def __len__(self) -> int:
        return int(self.is_counted.sum())

    def share_held(self, level: float) -> float:
        """Return the share of pairs in their sets of highest density of a level."""
        return float((self.joint[self.is_counted] <= level).double().mean())

    def level_needed(self, level: float) -> float:
        """Return the level of the sets of highest density that a guarantee needs.

        A set with a guarantee is about as large as a set of highest density of this
        level. Above 1 it reaches further than all draws.

        Raises:
            InvalidInputError: If there are too few pairs for the level.
        """
        check_enough(level, len(self))
        rank = rank_needed(level, len(self))
        return float(self.joint[self.is_counted].kthvalue(rank).values)


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

    Args:
        posterior: A posterior that has not seen the pairs.
        theta: Parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event)``.
        num_samples: The number of draws for each pair.
        seed: Seed of the draws.

    Raises:
        SamplingError: If the posterior has almost no mass inside the prior's support.
    """
    log_prob, levels, joint, marginal, by_estimate = [], [], [], [], []
    with explained(), seeded(seed):
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
def explained() -> Iterator[None]:
    """Say what to do if a stack has hardly any mass inside the prior's support."""
    try:
        yield
    except SamplingError as error:
        raise SamplingError(
            "A stack of these candidates has almost no mass inside the support of "
            "the prior at a held-out observation, so that it cannot be sampled. "
            "Add the prior to the candidates: `default_candidates()` contains it."
        ) from error


def joined(of_folds: Sequence[FoldScores], folds: Sequence[Tensor]) -> FoldScores:
    """Put the scores of folds together, in the order of the pairs.

    Args:
        of_folds: The scores of each fold.
        folds: The rows of each fold.
    """
    order = torch.cat(list(folds)).argsort()
    names = [entry.name for entry in fields(FoldScores)]
    return FoldScores(
        **{
            name: torch.cat([getattr(scores, name) for scores in of_folds])[order]
            for name in names
        }
    )
