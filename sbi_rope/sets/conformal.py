r"""The arithmetic of sets with a guarantee: scores, ranks and counts.

Every calibration pair i has a score :math:`S_i`, the level of the smallest set of the
posterior that contains its parameters. The posterior is that of its fold k(i), which
has not seen the pair. A new pair would have the scores :math:`S_{k}(x, \theta)` under
the K posteriors. If the new pair and the n calibration pairs are exchangeable, it is
rarely higher than most of them, so that the set

.. math:: \Big\{\theta:
    \#\{i: S_i < S_{k(i)}(x, \theta)\} < \lceil (1 - \alpha)(n + 1) \rceil \Big\}

holds the parameters with a probability of at least

.. math:: 1 - 2 \alpha - \min\Big\{ \frac{2 (1 - 1/K)}{n/K + 1},
    \frac{1 - K/n}{K + 1} \Big\},

and in practice of about :math:`1 - \alpha`. The bound is for folds of equal size. Those
of a stack differ by one pair at most, unless pairs share their parameters, or some
labels are not exact: only exact ones have scores, and they are not spread evenly.

References:
    | Predictive Inference with the Jackknife+ (Barber et al., 2021), theorem 4
    | https://arxiv.org/abs/1905.02928
    | Cross-conformal Predictors (Vovk, 2015), for sets that are no intervals
    | https://doi.org/10.1007/s10472-013-9368-4
"""

import math

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError

__all__ = [
    "check_enough",
    "interval_of",
    "is_held",
    "joint_scores",
    "marginal_ends",
    "marginal_scores",
    "promised_coverage",
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
    """Raise if n calibration pairs can give no guarantee at a level.

    Raises:
        InvalidInputError: If the level is below one half, or above n / (n + 1).
    """
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


def promised_coverage(level: float, n: int, num_folds: int) -> float:
    """Return the bound of the coverage in theory, at least 0; see this module.

    Example:
        >>> [round(promised_coverage(0.9, 50, folds), 3) for folds in (5, 50, 60)]
        [0.655, 0.8, 0.8]
    """
    # Folds without a counted pair change nothing.
    num_folds = min(num_folds, n)
    share = 1 / num_folds
    of_folds = 2 * (1 - share) / (n * share + 1)
    of_pairs = (1 - num_folds / n) / (num_folds + 1)
    return max(0.0, 1 - 2 * (1 - level) - min(of_folds, of_pairs))


def joint_scores(log_prob: Tensor, draws: Tensor) -> Tensor:
    r"""Return the level of the smallest set of highest density with theta.

    .. math:: S = \frac{1}{M + 1} \Big( \tfrac12 + \#\{m: \ell_m > \ell\}
        + \tfrac12 \#\{m: \ell_m = \ell\} \Big)

    Here :math:`\ell = \log p(\theta \mid x)`, and :math:`\ell_m` are those of M draws
    of the same posterior. If theta has a lower density than all draws, then
    :math:`S = 1 + \min_m \ell_m - \ell`. The scores of a posterior that is far too
    narrow then still say how much, and its sets are finite. The score is infinite where
    the density is zero.

    Args:
        log_prob: :math:`\ell`, shape ``(*batch, k)``.
        draws: :math:`\ell_m`, shape ``(*batch, M)``.

    Returns:
        Shape ``(*batch, k)``, float64.

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

    Args:
        theta: Values of the parameter, shape ``(*batch, k)``.
        draws: Draws of the parameter, shape ``(*batch, M)``.

    Returns:
        Shape ``(*batch, k)``, float64.

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

    They are :math:`F^{-1}((1 \mp S) / 2)`.

    Args:
        scores: S, shape ``(*batch, k)``.
        draws: Draws of the parameter, shape ``(*batch, M)``.

    Returns:
        The lower and the upper ends, each ``(*batch, k)``, float64.

    Example:
        >>> low, high = marginal_ends(torch.tensor([0.25, 2.5]), torch.arange(3.0))
        >>> low, high
        (tensor([ 0.5000, -2.0000], dtype=torch.float64),
         tensor([1.5000, 4.0000], dtype=torch.float64))
    """
    draws = _ordered(draws)
    return _quantile(draws, (1 - scores.double()) / 2), _quantile(
        draws, (1 + scores.double()) / 2
    )


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
    """Tell which parameters are in a set with a guarantee; see this module.

    Args:
        scores: The scores of the pairs, shape ``(n,)``.
        fold: The fold of each pair, shape ``(n,)``.
        at_theta: The scores of the parameters under the posterior of each fold, shape
            ``(K, k)``.
        level: The level, 1 - alpha.

    Returns:
        Shape ``(k,)``.

    Example:
        >>> scores, fold = torch.tensor([0.1, 0.3, 0.6]), torch.tensor([0, 0, 0])
        >>> is_held(scores, fold, torch.tensor([[0.2, 0.6, 0.7]]), level=0.75)
        tensor([ True,  True, False])
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
    that the scores of the pairs give at the new observation.

    Args:
        low: The lower ends, shape ``(n, *batch)``.
        high: The upper ends, shape ``(n, *batch)``.
        level: The level, 1 - alpha, at least one half.

    Returns:
        The lower and the upper ends, each ``(*batch)``.

    Example:
        >>> ends = torch.tensor([[1.0], [2.0], [3.0]])
        >>> interval_of(-ends, ends, level=0.75)
        (tensor([-3.]), tensor([3.]))
    """
    rank = rank_needed(level, len(low))
    return (
        low.kthvalue(len(low) + 1 - rank, dim=0).values,
        high.kthvalue(rank, dim=0).values,
    )
