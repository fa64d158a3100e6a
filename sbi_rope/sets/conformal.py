r"""The arithmetic of sets with a guarantee: scores, ranks and counts.

Every calibration pair i has a score :math:`S_i`, the level of the smallest set of the
posterior that contains its parameters. The posterior is that of its fold k(i), which
has not seen the pair. A new pair would have the scores :math:`S_{k}(x, \theta)` under
the K posteriors. If the new pair and the n calibration pairs are exchangeable, it is
rarely higher than most of them, so that the set

.. math:: \Big\{\theta:
    \#\{i: S_i < S_{k(i)}(x, \theta)\} < \lceil (1 - \alpha)(n + 1) \rceil \Big\}

holds the parameters as often as :class:`~sbi_rope.sets.Guarantee` says. Its bound is
for folds of equal size. Those of a stack differ by one pair at most, unless pairs share
their parameters, or some labels are not exact: only exact ones have scores, and they
are not spread evenly.

References:
    | Predictive Inference with the Jackknife+ (Barber et al., 2021), theorem 4
    | https://arxiv.org/abs/1905.02928
    | Cross-conformal Predictors (Vovk, 2015), for sets that are no intervals
    | https://doi.org/10.1007/s10472-013-9368-4
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError

__all__ = [
    "Guarantee",
    "check_enough",
    "interval_of",
    "is_held",
    "joint_scores",
    "marginal_ends",
    "marginal_scores",
    "rank_needed",
]

# Levels are decimal fractions, and (n + 1) times one of them may be a whole number.
DIGITS = 9
# Below this level the guarantee says nothing, and intervals may be empty.
LOWEST_LEVEL = 0.5


def rank_needed(level: float, n: int) -> int:
    r"""Return :math:`\lceil (1 - \alpha)(n + 1) \rceil` for a level of 1 - alpha.

    Example:
        >>> rank_needed(0.9, 9), rank_needed(0.9, 50)
        (9, 46)
    """
    return math.ceil(round(level * (n + 1), DIGITS))


def check_enough(level: float, n: int) -> None:
    """Raise if n pairs can give no guarantee at a level, which is above n / (n + 1)."""
    if level < LOWEST_LEVEL:
        raise InvalidInputError(
            f"Expected `level` of at least {LOWEST_LEVEL} for a set with a guarantee; "
            f"got {level:g}."
        )
    if rank_needed(level, n) > n:
        fewest = math.ceil(round(level / (1 - level), DIGITS))
        raise InvalidInputError(
            f"Expected `level` of at most {n / (n + 1):.3g} with {n} exact labels of "
            f"different groups; got {level:g}, which needs {fewest} labels."
        )


def joint_scores(log_prob: Tensor, draws: Tensor) -> Tensor:
    r"""Return the level of the smallest set of highest density with theta.

    .. math:: S = \frac{1}{M + 1} \Big( \tfrac12 + \#\{m: \ell_m > \ell\}
        + \tfrac12 \#\{m: \ell_m = \ell\} \Big)

    Here :math:`\ell = \log p(\theta \mid x)`, and :math:`\ell_m` are those of M draws
    of the same posterior. If theta has a lower density than all draws, then
    :math:`S = 1 + \min_m \ell_m - \ell`. The scores of a posterior that is far too
    narrow then still say how much, and its sets are finite. The score is infinite where
    the density is zero.
    Shapes are ``(*batch, k)`` and ``(*batch, M)`` to ``(*batch, k)``.

    References:
        | CD-split and HPD-split: Efficient Conformal Regions in High Dimensions
          (Izbicki et al., 2022)
        | https://arxiv.org/abs/2007.12778

    Example:
        >>> draws = torch.tensor([-1.0, -2.0, -3.0])
        >>> joint_scores(torch.tensor([0.0, -2.5, -5.0, -torch.inf]), draws)
        tensor([0.1250, 0.6250, 3.0000,    inf], dtype=torch.float64)
    """
    log_prob, draws = log_prob.double().contiguous(), _ordered(draws)
    num_draws = draws.shape[-1]
    below = torch.searchsorted(draws, log_prob)
    not_above = torch.searchsorted(draws, log_prob, right=True)
    rank = num_draws - (below + not_above) / 2 + 0.5
    lowest = draws[..., :1]
    level = rank.double() / (num_draws + 1)
    return torch.where(log_prob < lowest, 1 + lowest - log_prob, level)


def marginal_scores(theta: Tensor, draws: Tensor) -> Tensor:
    r"""Return the level of the smallest central interval with theta.

    .. math:: S = |2 F(\theta) - 1|

    F is the distribution function of a parameter. It is m / (M + 1) at the m-th
    smallest of M draws, and linear between the draws. Beyond them it goes on with a
    slope of one over their range, so that scores above 1 say how far theta is outside.
    At a value that several draws share, F has a jump. The score is then the smallest
    along the jump.
    Shapes are ``(*batch, k)`` and ``(*batch, M)`` to ``(*batch, k)``.

    References:
        | Distributional Conformal Prediction (Chernozhukov et al., 2021)
        | https://arxiv.org/abs/1909.07889

    Example:
        >>> draws = torch.tensor([0.0, 1.0, 2.0])
        >>> marginal_scores(torch.tensor([1.0, 1.5, 4.0]), draws)
        tensor([0.0000, 0.2500, 2.5000], dtype=torch.float64)
    """
    theta, draws = theta.double().contiguous(), _ordered(draws)
    last = draws.shape[-1] - 1
    left = torch.searchsorted(draws, theta)
    right = torch.searchsorted(draws, theta, right=True)
    # The neighbours of a value between two draws.
    before = draws.gather(-1, (left - 1).clamp(0, last))
    after = draws.gather(-1, left.clamp(0, last))
    between = left + (theta - before) / torch.where(after > before, after - before, 1.0)
    is_draw = right > left
    start = torch.where(is_draw, left + 1, between) / (last + 2)
    end = torch.where(is_draw, right, between) / (last + 2)
    inside = torch.maximum(2 * start - 1, 1 - 2 * end).clamp_min(0.0)
    lowest, highest = draws[..., :1], draws[..., -1:]
    distance = torch.maximum(lowest - theta, theta - highest)
    beyond = last / (last + 2) + 2 * distance / (highest - lowest)
    return torch.where(distance > 0, beyond, inside)


def marginal_ends(scores: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the ends of all parameters whose :func:`marginal_scores` are not higher.

    Of scores S ``(*batch, k)`` and draws ``(*batch, M)``, the lower and the upper ends
    are :math:`F^{-1}((1 \mp S) / 2)`, each ``(*batch, k)``.
    """
    draws, scores = _ordered(draws), scores.double()
    return _quantile(draws, (1 - scores) / 2), _quantile(draws, (1 + scores) / 2)


def _ordered(draws: Tensor) -> Tensor:
    """Return draws in order; torch searches rows that are contiguous without a copy."""
    return draws.double().contiguous().sort().values


def _quantile(draws: Tensor, probability: Tensor) -> Tensor:
    """Return the inverse of the F of :func:`marginal_scores`, from sorted draws."""
    last = draws.shape[-1] - 1
    position = probability * (last + 2) - 1
    start = position.floor().clamp(0, max(last - 1, 0)).long()
    low = draws.gather(-1, start)
    high = draws.gather(-1, (start + 1).clamp_max(last))
    inside = low + (position.clamp(0, last) - start) * (high - low)
    # Beyond the draws, in units of their range. Infinitely many units of a range of
    # zero are infinite, as the score is.
    beyond = (position - position.clamp(0, last)) / (last + 2)
    reach = draws[..., -1:] - draws[..., :1]
    return inside + torch.where(beyond.isinf(), beyond, beyond * reach)


def is_held(scores: Tensor, fold: Tensor, at_theta: Tensor, *, level: float) -> Tensor:
    """Tell which parameters are in a set with a guarantee, ``(k,)``; see this module.

    The scores and folds of the pairs have the shape ``(n,)``. Those of the parameters
    under the posterior of each fold, ``at_theta``, have ``(K, k)``.
    """
    below = torch.zeros(at_theta.shape[1], dtype=torch.long, device=at_theta.device)
    for number, of_theta in enumerate(at_theta):
        ordered = scores[fold == number].sort().values
        below += torch.searchsorted(ordered, of_theta.contiguous())
    return below < rank_needed(level, len(scores))


def interval_of(low: Tensor, high: Tensor, *, level: float) -> tuple[Tensor, Tensor]:
    r"""Return the interval that contains the set with a guarantee, of each parameter.

    It ends at the :math:`\lfloor \alpha (n + 1) \rfloor`-th smallest lower end and the
    :math:`\lceil (1 - \alpha)(n + 1) \rceil`-th smallest upper end of the n intervals
    that the scores of the pairs give at the new observation, ``(n, *batch)`` to
    ``(*batch)``. The level is at least one half.
    """
    rank = rank_needed(level, len(low))
    return (
        low.kthvalue(len(low) + 1 - rank, dim=0).values,
        high.kthvalue(rank, dim=0).values,
    )


@dataclass(frozen=True, kw_only=True)
class Guarantee:
    r"""The promise of a set or interval, for observations drawn as the pairs were.

    Let the calibration pairs and the new observation with its parameters be
    exchangeable, as pairs are that are drawn independently from one distribution. The
    set then holds the parameters with a probability of at least

    .. math:: 1 - 2 \alpha - \min\Big\{ \frac{2 (1 - 1/K)}{n/K + 1},
        \frac{1 - K/n}{K + 1} \Big\}, \qquad \alpha = 1 - \text{level},

    in theory, and of about the level in practice. Ninety per cent with 50 pairs in 5
    folds means at least 65.5 % in theory. The probability is an average over
    calibration sets and observations. It is not that at a given observation.

    The theorem holds for the candidates of a stack, which have not seen the labels of
    the fold that they are scored on. The weights of the stack, a few numbers, depend on
    these labels a little. In simulations with 10 to 50 pairs this changes the coverage
    by less than one per cent. Nothing is promised for observations drawn in another way
    than the pairs: :func:`sbi_rope.diagnose` compares a batch with them. A set ends
    where the support of the prior ends. The probability of parameters beyond it is in
    addition to that of a miss.

    References:
        | Predictive Inference with the Jackknife+ (Barber et al., 2021), theorem 4
        | https://arxiv.org/abs/1905.02928

    Attributes:
        level: The level that was asked for.
        num_pairs: The number n of calibration pairs with exact labels, one of each
            group.
        num_folds: The number K of folds.
    """

    level: float
    num_pairs: int
    num_folds: int

    @property
    def lower_bound(self) -> float:
        """The least probability in theory; 0 if theory promises nothing."""
        # Folds without a counted pair change nothing.
        n, num_folds = self.num_pairs, min(self.num_folds, self.num_pairs)
        share = 1 / num_folds
        of_folds = 2 * (1 - share) / (n * share + 1)
        of_pairs = (1 - num_folds / n) / (num_folds + 1)
        return max(0.0, 1 - 2 * (1 - self.level) - min(of_folds, of_pairs))

    def says(self, what: str) -> str:
        """Return the promise in words, of what holds what."""
        return (
            f"For observations drawn as the {self.num_pairs} calibration pairs were, "
            f"{what} in about {self.level:.4g} of the cases, and in at least "
            f"{self.lower_bound:.3f} of them in theory, on average over observations "
            "and calibration sets."
        )

    def __str__(self) -> str:
        return self.says("it holds the true parameters")

    __repr__ = __str__  # which notebooks show
