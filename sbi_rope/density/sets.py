r"""Credible sets and intervals, with a guarantee or without.

The score :math:`S(x, \theta)` is the level of the smallest set of highest density that
contains the parameters, or of the smallest central interval of one parameter. A set
holds all parameters whose score is at most its level :math:`1 - \alpha`. For a
guarantee, the scores :math:`S_i` of n calibration pairs take the place of the level.
Each score is that of the posterior of fold k(i), which has not seen the pair:

.. math:: \Big\{\theta:
    \#\{i: S_i < S_{k(i)}(x, \theta)\} < \lceil (1 - \alpha)(n + 1) \rceil \Big\}

(Vovk, 2015, https://doi.org/10.1007/s10472-013-9368-4).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Level, check, default_names
from sbi_rope.utils.tensors import as_batch, as_numbers

LOWEST_LEVEL = 0.5  # Below, the guarantee says nothing, and intervals may be empty.
MAX_PRINTED = 20  # intervals


def joint_scores(log_prob: Tensor, draws: Tensor) -> Tensor:
    r"""Return the level of the smallest set of highest density with theta.

    .. math:: S = \frac{1}{M + 1} \Big( \tfrac12 + \#\{m: \ell_m > \ell\}
        + \tfrac12 \#\{m: \ell_m = \ell\} \Big)

    with log densities :math:`\ell` of theta, ``(*batch, k)``, and :math:`\ell_m` of M
    draws, ``(*batch, M)``. Below all draws, :math:`S = 1 + \min_m \ell_m - \ell` still
    says how far a posterior is off. (Izbicki et al., 2022, arXiv 2007.12778)
    """
    log_prob, draws = log_prob.double().contiguous(), _ordered(draws)
    num_draws, lowest = draws.shape[-1], draws[..., :1]
    below = torch.searchsorted(draws, log_prob)
    not_above = torch.searchsorted(draws, log_prob, right=True)
    rank = num_draws - (below + not_above).double() / 2 + 0.5
    beyond = 1 + lowest - log_prob
    return torch.where(log_prob < lowest, beyond, rank / (num_draws + 1))


def marginal_scores(theta: Tensor, draws: Tensor) -> Tensor:
    r"""Return the level :math:`|2 F(\theta) - 1|` of the central interval up to theta.

    F is m / (M + 1) at the m-th smallest of M draws, ``(*batch, M)``, and linear
    between them. Beyond them its slope is one over their range. Of equal draws the
    smallest number m counts. (Chernozhukov et al., 2021, arXiv 1909.07889)
    """
    theta, draws = theta.double().contiguous(), _ordered(draws)
    last = draws.shape[-1] - 1
    left = torch.searchsorted(draws, theta)
    before = draws.gather(-1, (left - 1).clamp(0, last))
    after = draws.gather(-1, left.clamp(0, last))
    place = left + (theta - before) / torch.where(after > before, after - before, 1.0)
    inside = (2 * place.clamp_min(1) / (last + 2) - 1).abs()
    distance = torch.maximum(draws[..., :1] - theta, theta - draws[..., -1:])
    beyond = last / (last + 2) + 2 * distance / _range(draws)
    return torch.where(distance > 0, beyond, inside)


def marginal_ends(scores: Tensor, draws: Tensor) -> Tensor:
    """Return the ends, ``(2, *batch, k)``, between which marginal scores are lower."""
    draws = _ordered(draws)
    last = draws.shape[-1] - 1
    draws = draws.expand(2, *draws.shape)
    position = (1 + torch.stack([-scores, scores]).double()) / 2 * (last + 2) - 1
    start = position.floor().clamp(0, max(last - 1, 0)).long()
    low, high = (draws.gather(-1, at) for at in (start, (start + 1).clamp_max(last)))
    inside = low + (position.clamp(0, last) - start) * (high - low)
    beyond = (position - position.clamp(0, last)) / (last + 2)
    return inside + beyond * _range(draws)


def _ordered(draws: Tensor) -> Tensor:
    """Return draws in order; torch searches rows that are contiguous without a copy."""
    return draws.double().contiguous().sort().values


def _range(draws: Tensor) -> Tensor:
    return (draws[..., -1:] - draws[..., :1]).clamp_min(1e-9)  # draws may be equal


def _round_up(number: float) -> int:
    return math.ceil(round(number, 9))  # 10 times 0.7 is a little more than 7


def rank_needed(level: float, n: int) -> int:
    r"""Return :math:`\lceil (1 - \alpha)(n + 1) \rceil` for a level of 1 - alpha."""
    return _round_up(level * (n + 1))


def is_held(scores: Tensor, fold: Tensor, at_theta: Tensor, *, rank: int) -> Tensor:
    """Tell which parameters, ``(*batch)``, score higher than fewer than ``rank`` pairs.

    Scores of pairs, ``(n, ...)``, are compared with those of the parameters under the
    posterior of their fold, from ``(K, *batch)``.
    """
    below = torch.zeros_like(at_theta[0], dtype=torch.long)
    for score, number in zip(scores, fold.tolist(), strict=True):
        below += score < at_theta[number]
    return below < rank


@dataclass(frozen=True, eq=False, kw_only=True)
class SetScores:
    """The out-of-fold scores of n pairs, from which sets with a guarantee are made.

    All labels are exact. Pairs of one group are not exchangeable, so that only one of
    them counts, chosen at random.

    Attributes:
        joint: The ``joint_scores`` of the true parameters, shape ``(n,)``.
        marginal: The ``marginal_scores`` of each parameter, shape ``(n, d)``.
        fold: The fold of each pair, shape ``(n,)``.
        weights: The weights of the stack that scored each fold, shape ``(F, K)``.
        num_draws: The number of draws that the scores were computed from.
    """

    joint: Tensor
    marginal: Tensor
    fold: Tensor
    weights: Tensor
    num_draws: int

    def __len__(self) -> int:
        return len(self.joint)

    def share_held(self, level: float) -> float:
        """Return the share of pairs in their sets of highest density of a level."""
        return float((self.joint <= level).double().mean())

    def rank(self, level: float) -> int:
        """Return ``rank_needed`` for a guarantee; raise if the pairs cannot give it."""
        n, rank = len(self), rank_needed(level, len(self))
        if level < LOWEST_LEVEL or rank > n:
            raise InvalidInputError(
                f"Expected `level` from {LOWEST_LEVEL} to {n / (n + 1):.3g}, as {n} "
                f"exact labels of different groups can guarantee; got {level:g}."
            )
        return rank


@dataclass(frozen=True, eq=False, kw_only=True)
class CredibleSet:
    """What is credible given an observation, or each of a batch.

    ``posterior.credible_set`` makes it. It is a set of all parameters together, and an
    interval of each. Every interval has the level by itself, so that all parameters
    are in their intervals less often.

    Attributes:
        level: The level that was asked for.
        guarantee: What is promised of the set and of each interval, in words; None if
            nothing is.
        low: The lower ends of the intervals, shape ``(d,)``, or ``(B, d)`` of a batch.
        high: The upper ends, as ``low``.
        rule: Tells which parameters ``(n, B, d)`` are in the sets, ``(n, B)``.
        parameter_names: One name for each parameter; None if they have none.
    """

    level: float
    guarantee: str | None
    low: Tensor
    high: Tensor
    rule: Callable[[Tensor], Tensor]
    parameter_names: tuple[str, ...] | None

    @torch.no_grad()
    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters ``(*batch, d)`` are in the set, shape ``(*batch)``.

        For sets of a batch these are ``(*batch, B, d)`` and ``(*batch, B)``.
        """
        rows, shape = self._rows(theta)
        return self.rule(rows.reshape(len(rows), -1, shape[-1])).reshape(shape[:-1])

    def contains_each(self, theta: Tensor) -> Tensor:
        """Tell which parameters are in their intervals, one by one, as theta."""
        rows, shape = self._rows(theta)
        return ((self.low <= rows) & (rows <= self.high)).reshape(shape)

    def _rows(self, theta: Any) -> tuple[Tensor, torch.Size]:
        """Return parameters as ``(n, *low.shape)``, and the shape that they had."""
        theta = as_numbers("theta", theta, names=self.parameter_names)
        count = max(1, theta.ndim - self.low.ndim)
        rows = theta if theta.ndim > self.low.ndim else theta[None]
        rows = as_batch("theta", rows.flatten(0, count - 1), self.low.shape)
        return rows.to(self.low), theta.shape

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each parameter of each observation, with its interval."""
        width = self.low.shape[-1]
        names = self.parameter_names or default_names(width)
        ends = torch.stack([self.low, self.high], dim=-1).reshape(-1, width, 2).tolist()
        return [
            {"observation": number, "parameter": name, "low": low, "high": high}
            for number, of_one in enumerate(ends)
            for name, (low, high) in zip(names, of_one, strict=True)
        ]

    def __str__(self) -> str:
        lines = [f"{100 * self.level:.4g}% intervals of each parameter by itself:"]
        rows = self.as_rows()
        for row in rows[:MAX_PRINTED]:
            number = f"observation {row['observation']}, " * (self.low.ndim > 1)
            ends = f"{row['low']:.6g} to {row['high']:.6g}"
            lines.append(f"  {number}{row['parameter']}: {ends}")
        if len(rows) > MAX_PRINTED:
            lines.append(f"  and {len(rows) - MAX_PRINTED} more")
        if self.low.shape[-1] > 1:
            lines.append("All parameters together are inside less often.")
        no = "There is no guarantee. The level is right for calibrated posteriors."
        return "\n".join([*lines, self.guarantee or no])

    __repr__ = __str__  # which notebooks show


class MakesSets:
    """What a posterior inherits to make sets and intervals."""

    def credible_set(
        self: Any,
        level: float = 0.9,
        x: Any = None,
        *,
        guaranteed: bool = False,
        num_samples: int = 1000,
        seed: int | None = None,
    ) -> CredibleSet:
        r"""Return a set and intervals that are credible given x, or each of a batch.

        The set is that of highest density,
        :math:`\{\theta: \log p(\theta \mid x) \ge t\}`, with t the (1 - level)
        quantile of the log density of draws, and the intervals are the central ones of
        draws. They hold the true parameters with the probability ``level`` only if the
        posterior is calibrated. With ``guaranteed``, a stack corrects them by its
        out-of-fold scores. Suppose that the n calibration pairs, in K folds, and the
        new observation with its parameters are exchangeable, as independent draws are.
        The probability is then about ``level`` in practice, on average over calibration
        sets and observations, and, up to the weights of the stack, in theory at least

        .. math:: 1 - 2 \alpha - \min\Big\{ \frac{2 (1 - 1/K)}{n/K + 1},
            \frac{1 - K/n}{K + 1} \Big\}, \qquad \alpha = 1 - \text{level}.

        Parameters beyond the support of the prior are missed in addition.

        References:
            | Predictive Inference with the Jackknife+ (Barber et al., 2021), theorem 4
            | https://arxiv.org/abs/1905.02928

        Args:
            level: The probability of the set, and of each interval by itself.
            x: An observation ``(*event)``, or a batch ``(B, *event)``, from the batch
                of the posterior if there is one; the default x if None.
            guaranteed: Whether they shall hold the true parameters in about ``level``
                of the cases, even if the posterior is not calibrated. This needs a
                stack, and observations drawn as its calibration pairs.
            num_samples: The number of draws, of which some have to be outside. With
                ``guaranteed`` there are as many as the stack was scored with.
            seed: Seed of the draws; None uses the states of torch, NumPy and Python.

        Raises:
            InvalidInputError: If there are too few draws for the level. With
                ``guaranteed``, if this is no stack, or if it has too few pairs.
            LogProbUnavailableError: If ``contains`` is called without a density.
        """
        check("level", level, Level)
        check("num_samples", num_samples, Count)
        density = self.posterior_estimator
        is_one = x is None or np.ndim(x) == len(density.condition_shape)
        x = self._one_x(x) if is_one else self._batch_of_x(x)
        shape = density.input_shape if is_one else (len(x), *density.input_shape)
        make = _guaranteed if guaranteed else _of_draws
        with seeded(seed), torch.no_grad():
            guarantee, low, high, rule = make(self, level, x, num_samples)
        return CredibleSet(
            level=level,
            guarantee=guarantee,
            low=low.to(x).reshape(shape),
            high=high.to(x).reshape(shape),
            rule=rule,
            parameter_names=self.parameter_names,
        )

    def _held_out(self) -> tuple[SetScores, Sequence[Any]]:
        """Return out-of-fold scores, and the stack that has not seen each fold."""
        raise InvalidInputError(
            "Expected a stack for a set with a guarantee; got "
            f"{type(self).__name__}. Make one with `stack(rope)`."
        )


def _of_draws(posterior: Any, level: float, x: Tensor, num_samples: int) -> Any:
    """Return no guarantee, the ends of central intervals, and the rule of the set."""
    if num_samples < (needed := _round_up(2 / (1 - level))):
        raise InvalidInputError(
            f"Expected `num_samples` of at least {needed} for a level of {level:g}, so "
            f"that a draw is beyond each end; got {num_samples}."
        )
    draws = _draw(posterior, num_samples, x)
    tails = (1 - level) / 2, (1 + level) / 2
    ends = np.quantile(draws.double().cpu().numpy(), tails, axis=0)

    def rule(theta: Tensor) -> Tensor:
        number = num_samples + 1 - _round_up(level * num_samples)
        least = _log_prob(posterior, draws, x).kthvalue(number, keepdim=True).values
        return (_log_prob(posterior, theta, x) >= least).T

    return None, *map(torch.from_numpy, ends), rule


def _guaranteed(posterior: Any, level: float, x: Tensor, num_samples: int) -> Any:
    """Return the guarantee, the ends of intervals, and the rule of the set."""
    pairs, stacks = posterior._held_out()
    rank = pairs.rank(level)
    guarantee = (
        f"For observations drawn as the {len(pairs)} calibration pairs were, the truth "
        f"is inside in about {level:.4g} of the cases, on average over observations "
        "and calibration sets."
    )
    draws = [_draw(one, pairs.num_draws, x) for one in stacks]
    of_folds = []
    for number, own in enumerate(draws):
        scores = pairs.marginal[pairs.fold == number].T.to(own.device)
        scores = scores.expand(len(x), -1, -1)
        of_folds.append(marginal_ends(scores, own.permute(1, 2, 0)))
    low, high = torch.cat(of_folds, dim=-1)
    low = low.kthvalue(len(pairs) + 1 - rank).values
    high = high.kthvalue(rank).values
    least, most = posterior.prior.bounds(low)

    def rule(theta: Tensor) -> Tensor:
        at_theta = [
            joint_scores(_log_prob(one, theta, x), _log_prob(one, own, x))
            for one, own in zip(stacks, draws, strict=True)
        ]
        scores = pairs.joint.to(x.device)
        held = is_held(scores, pairs.fold, torch.stack(at_theta), rank=rank).T
        return held & posterior.prior.inside(theta.flatten(0, 1)).view_as(held)

    return guarantee, low.clamp(least, most), high.clamp(least, most), rule


def _draw(posterior: Any, num_samples: int, x: Tensor) -> Tensor:
    return posterior.sample_batched((num_samples,), x, show_progress_bars=False)


def _log_prob(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Return log densities up to the mass in the prior's support, ``(B, M)``."""
    return posterior.log_prob_batched(theta, x, norm_posterior=False).T
