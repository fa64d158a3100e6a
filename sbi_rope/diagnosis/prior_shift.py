"""Compare the parameters that the batch implies with the prior."""

from collections.abc import Container, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.data.pairs import group_means, without_warning_of_few_pairs
from sbi_rope.data.simulate import targets
from sbi_rope.diagnosis.report import Finding
from sbi_rope.metrics.statistics import LEVEL
from sbi_rope.npe.sbi import embed
from sbi_rope.rope.rope import RoPE
from sbi_rope.utils.tensors import divisors

# At tau = 0 each observation is coupled by itself, without trust in the prior. The
# smaller gamma is, the less the implied distribution is blurred.
COUPLER = SinkhornCoupler(gamma=0.1, tau=0.0, cost_scale="simulated")
# The largest number of simulations that take the place of observations.
MAX_PLAYERS = 1000
ERROR_QUANTILE = 0.95
# Points at which distribution functions are compared.
NUM_POINTS = 100
NUM_DRAWS = 1000  # of batches of simulations
# So many simulations give a covariance with errors of a few per cent.
MAX_FOR_NOISE = 2000
CHUNK = 500  # points whose weights are computed at a time


def noise_of(theta: Tensor, embedded: Tensor) -> Tensor:
    r"""Return the covariance :math:`W` of :math:`h(x_s)` given theta, ``(l, l)``.

    It is estimated from differences between simulations with neighbouring parameters,
    without a quadratic trend. With many parameters and few simulations, neighbours are
    far apart and the estimate is too large.
    """
    theta, embedded = theta[:MAX_FOR_NOISE], embedded[:MAX_FOR_NOISE]
    standard = (theta - theta.mean(dim=0)) / divisors(theta.std(dim=0))
    ones = torch.ones_like(standard[:, :1])
    features = torch.cat([ones, standard, standard.square()], dim=1)
    residual = embedded - features @ (torch.linalg.pinv(features) @ embedded)
    distance = torch.cdist(standard, standard).fill_diagonal_(torch.inf)
    difference = residual - residual[distance.argmin(dim=1)]
    return difference.T @ difference / (2 * len(difference))


def averaged(points: Tensor, theta: Tensor, embedded: Tensor) -> Tensor:
    r"""Move embeddings ``(n, l)`` as tuning does if nothing is wrong.

    Tuning moves :math:`g(x)` towards :math:`E[h \mid \theta]`. It can reach at best the
    mean of this given x, to first order :math:`\mu + (I - W V^{-1})(h - \mu)`, with V
    the covariance of h.
    """
    mean = embedded.mean(dim=0)
    centred = embedded - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(centred))
    kept = values > 1e-10 * values.max()
    root = vectors[:, kept] * values[kept].sqrt()
    inverse = vectors[:, kept] / values[kept].sqrt()
    noise = inverse.T @ noise_of(theta, embedded) @ inverse
    share, basis = torch.linalg.eigh(noise)
    left = (1.0 - share).clamp(0.0, 1.0)
    return mean + (points - mean) @ (inverse @ (basis * left) @ basis.T @ root.T)


def cross_fit(rope: RoPE, num_folds: int, *, show: bool) -> tuple[Tensor, Tensor]:
    r"""Return g(x) of each pair, of a net g trained on the other folds, and its target.

    The target is :math:`E[h(S(\theta))]`. Both have shape ``(n_c, l)``.
    """
    pairs, h, finetuner = rope.pairs, rope.npe.h, rope.finetuner
    count = finetuner.simulations_per_target
    of_pairs = targets(rope.source, pairs, count, partial(embed, h))
    # Recordings of one person share a fold, as they do in a stack.
    folds = pairs.folds(num_folds)
    others = [torch.cat([*folds[:k], *folds[k + 1 :]]) for k in range(len(folds))]
    with without_warning_of_few_pairs():
        nets, _ = finetuner.tuned(
            h,
            pairs.x,
            [of_pairs] * len(folds),
            others,
            groups=pairs.group,
            weights=pairs.weight,
            draw_simulations=lambda n: rope.source.from_prior(n, seed=0)[1],
            show_progress_bars=show,
        )
    embedded = torch.empty_like(of_pairs)
    for number, held_out in enumerate(folds):
        embedded[held_out] = embed(nets.member(number), pairs.x[held_out])
    return embedded.cpu().double(), of_pairs.cpu().double()


class PriorShift(NamedTuple):
    """How far the parameters of a batch are from the prior, and what they are.

    ``distance``, ``(d,)``, is the Kolmogorov-Smirnov distance between the parameters of
    the batch and of one that follows the prior. Above ``threshold`` it is alarming.
    ``implied`` and ``unshifted``, ``(n_s,)``, are weights of simulations for the two.
    """

    distance: Tensor
    threshold: Tensor
    implied: Tensor
    unshifted: Tensor


def prior_shift(
    real: Tensor,
    theta: Tensor,
    ends: Sequence[Tensor],
    held_out: tuple[Tensor, Tensor, Tensor] | None = None,
) -> PriorShift:
    """Compare the parameters implied by a batch with those implied by simulations.

    The mean weights over the batch estimate the distribution of its parameters. They
    are blurred by gamma, by each posterior and by tuning, so that they understate a
    shift. Therefore the batch is compared with simulations that take the place of
    observations. Of a tuned g there are two ``ends``: simulations as tuning would move
    them, and unchanged. A g that was trained little is in between.

    A g that was tuned on few pairs misses its targets, and the batch looks shifted too.
    The same distance is measured between pairs that g has not seen and their targets
    (``held_out``, with groups), and its 95 % quantile is added to the threshold.
    """
    embedded = ends[-1]
    # At tau = 0 rows do not depend on one another, so that a few are enough.
    coupling = COUPLER.couple(embedded[:100], embedded)
    implied, functions = _implied_by(coupling, real, theta)
    players = [
        _implied_by(coupling, end[:MAX_PLAYERS], theta, others=True) for end in ends
    ]
    unshifted, expected = players[0]
    chances = []
    for _, end in players:
        # The expectation is itself a mean over simulations, with its own uncertainty.
        gaps = _resampled(end, len(real)) - _resampled(expected, len(expected))
        largest = gaps.abs().amax(dim=-1)
        chances.append(largest.quantile(1.0 - LEVEL / theta.shape[1], dim=0))
    threshold = torch.stack(chances).amax(dim=0)
    if held_out is not None:
        points, targets, group = held_out
        _, found = _implied_by(coupling, points, theta)
        _, wanted = _implied_by(coupling, targets, theta)
        # With few groups the errors could be small by chance, hence a bootstrap.
        one_each = torch.ones(len(found))
        difference, _ = group_means(found - wanted, one_each, group)
        largest = _resampled(difference, len(difference)).abs().amax(dim=-1)
        threshold = threshold + largest.quantile(ERROR_QUANTILE, dim=0)
    distance = (functions.mean(dim=0) - expected.mean(dim=0)).abs().amax(dim=-1)
    return PriorShift(distance, threshold, implied, unshifted)


def shifts(
    shift: PriorShift,
    theta: Tensor,
    names: Sequence[str],
    learned: Container[str],
    *,
    tuned: bool,
) -> list[Finding]:
    """Say for each parameter whether the batch has other values than the prior.

    A shift of parameters whose names are ``learned`` is no alarm.
    """
    weights = torch.stack([shift.implied, shift.unshifted])
    standard = (theta - theta.mean(dim=0)) / divisors(theta.std(dim=0))
    mean = weights @ standard
    spread = (weights @ standard.square() - mean.square()).clamp_min(0.0).sqrt()
    move, ratio = mean[0] - mean[1], spread[0] / divisors(spread[1])
    doubt = "Without calibration pairs, misspecification looks the same."
    if tuned:
        doubt = "In RoPE, lower tau. A stack needs pairs that are drawn like the batch."
    found = []
    for k, name in enumerate(names):
        distance, threshold = float(shift.distance[k]), float(shift.threshold[k])
        test, is_alarming = f"prior shift: {name}", False
        if threshold >= 1.0:  # no distance is larger
            why = "there are too few observations or calibration pairs"
            found.append(Finding(test, f"Not tested, because {why}."))
            continue
        numbers = f"distance {distance:.2g}, limit {threshold:.2g}"
        sentence = f"No sign of it ({numbers})."
        if distance > threshold:
            is_alarming = name not in learned
            expected = "This is expected: the stack has learned it from the pairs."
            sentence = (
                f"The batch seems to differ from the prior in {name} ({numbers}). "
                f"The mean is at least {abs(move[k]):.2f} prior standard deviations "
                f"{'higher' if move[k] > 0 else 'lower'}, and the spread "
                f"{ratio[k]:.2f} times the usual. "
                f"{doubt if is_alarming else expected}"
            )
        found.append(Finding(test, sentence, is_alarming, distance, threshold))
    return found


def _implied_by(
    coupling: Coupling, points: Tensor, theta: Tensor, *, others: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the parameters that embeddings ``(n, l)`` imply.

    With ``others`` a point is not matched with the simulation in its own row.

    Returns:
        The mean weights of the simulations, ``(n_s,)``, which sum to one; and the
        distribution functions of each point, ``(n, d, NUM_POINTS)``.
    """
    order, last = theta.argsort(dim=0), len(theta) - 1
    # The ranks at which distribution functions are compared.
    where = torch.linspace(0, last, min(NUM_POINTS, len(theta))).round().long()
    total, functions = torch.zeros(len(theta), dtype=torch.float64), []
    for rows in torch.arange(len(points)).split(CHUNK):
        weights = coupling.rows(points[rows])
        if others:
            weights = weights.scatter(1, rows[:, None], 0.0)
            weights /= weights.sum(dim=1, keepdim=True).clamp_min(1e-300)
        total += weights.sum(dim=0)
        each = [weights[:, column].cumsum(dim=1)[:, where] for column in order.T]
        functions.append(torch.stack(each, dim=1))
    return total / len(points), torch.cat(functions)


def _resampled(values: Tensor, size: int) -> Tensor:
    """Return means over ``size`` rows drawn with replacement, ``(1000, ...)``."""
    count = len(values)
    rows = torch.randint(count, (NUM_DRAWS, size))
    rows += count * torch.arange(NUM_DRAWS).unsqueeze(1)
    times = torch.bincount(rows.flatten(), minlength=NUM_DRAWS * count)
    draws = times.reshape(NUM_DRAWS, count).to(values)
    mean = draws @ values.reshape(count, -1) / size
    return mean.reshape(NUM_DRAWS, *values.shape[1:])
