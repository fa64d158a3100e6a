"""Compare the parameters that the batch implies with the prior."""

from collections.abc import Container, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.residuals import HeldOut
from sbi_rope.diagnosis.simulations import Simulations, implied_by, resampled
from sbi_rope.metrics.statistics import LEVEL
from sbi_rope.utils.tensors import divisors

# At tau = 0 each observation is coupled by itself, without trust in the prior. The
# smaller gamma is, the less the implied distribution is blurred.
COUPLER = SinkhornCoupler(gamma=0.1, tau=0.0, cost_scale="simulated")
# The largest number of simulations that take the place of observations.
MAX_PLAYERS = 1000
ERROR_QUANTILE = 0.95
LEARNED = "This is expected: the stack has learned it from the pairs."


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
    real: Tensor, simulations: Simulations, held_out: HeldOut | None = None
) -> PriorShift:
    """Compare the parameters implied by a batch with those implied by simulations.

    The mean of :func:`implied_by`'s weights over the batch estimates the distribution
    of its parameters. It is blurred by gamma, by each posterior and by tuning, so that
    it understates a shift: in the linear-Gaussian problem of the tests, a true mean of
    1.14 is estimated as 0.81 in two dimensions and 0.37 in ten, and 0.63 and 0.31 after
    tuning. Therefore the batch is compared with simulations that take the place of
    observations, both unchanged and as tuning would move them.

    A g that was tuned on few pairs misses its targets, and the batch looks shifted too.
    The same distance is measured between calibration pairs that g has not seen and
    their targets, and the 95 % quantile of its bootstrap is added to the threshold.
    """
    theta, embedded = simulations.theta, simulations.embedded
    # At tau = 0 rows do not depend on one another, so that a few are enough.
    coupling = COUPLER.couple(embedded[:100], embedded)
    implied, functions = implied_by(coupling, real, theta)
    moved = simulations.averaged[:MAX_PLAYERS]
    unshifted, expected = implied_by(coupling, moved, theta, others=True)
    # A g that was trained little averages less over noise. The threshold allows for the
    # two ends, full averaging and none.
    ends = [expected]
    if simulations.tuned:
        unmoved = embedded[:MAX_PLAYERS]
        ends.append(implied_by(coupling, unmoved, theta, others=True)[1])
    chances = []
    for end in ends:
        # The expectation is itself a mean over simulations, with its own uncertainty.
        batches = resampled(end, len(real)), resampled(expected, len(expected))
        gaps = (batches[0] - batches[1]).abs().amax(dim=-1)
        chances.append(gaps.quantile(1.0 - LEVEL / theta.shape[1], dim=0))
    threshold = torch.stack(chances).amax(dim=0)
    if held_out is not None:
        targets = simulations.average(held_out.targets)
        _, found = implied_by(coupling, held_out.embedded, theta)
        _, wanted = implied_by(coupling, targets, theta)
        # With few groups the errors could be small by chance, hence a bootstrap.
        difference = held_out.mean_of_groups(found - wanted)
        means = resampled(difference, len(difference))
        threshold = threshold + means.abs().amax(dim=-1).quantile(ERROR_QUANTILE, dim=0)
    distance = (functions.mean(dim=0) - expected.mean(dim=0)).abs().amax(dim=-1)
    return PriorShift(distance, threshold, implied, unshifted)


def shifts(
    shift: PriorShift,
    simulations: Simulations,
    names: Sequence[str],
    learned: Container[str] = (),
) -> list[Finding]:
    """Say for each parameter whether the batch has other values than the prior.

    A shift of parameters whose names are ``learned`` is no alarm.
    """
    theta, weights = simulations.theta, torch.stack([shift.implied, shift.unshifted])
    standard = (theta - theta.mean(dim=0)) / divisors(theta.std(dim=0))
    mean = weights @ standard
    spread = (weights @ standard.square() - mean.square()).clamp_min(0.0).sqrt()
    move, ratio = mean[0] - mean[1], spread[0] / divisors(spread[1])
    doubt = "Without calibration pairs, misspecification looks the same."
    if simulations.tuned:
        doubt = "In RoPE, lower tau. A stack needs pairs that are drawn like the batch."
    found = []
    for k, name in enumerate(names):
        distance, threshold = float(shift.distance[k]), float(shift.threshold[k])
        test = f"prior shift: {name}"
        if threshold >= 1.0:  # no distance is larger
            why = "there are too few observations or calibration pairs"
            found.append(Finding(test, f"Not tested, because {why}."))
            continue
        numbers = f"distance {distance:.2g}, limit {threshold:.2g}"
        sentence, is_shifted = f"No sign of it ({numbers}).", distance > threshold
        if is_shifted:
            higher = "higher" if move[k] > 0 else "lower"
            sentence = (
                f"The batch seems to differ from the prior in {name} ({numbers}). "
                f"The mean is at least {abs(move[k]):.2f} prior standard deviations "
                f"{higher}, and the spread {ratio[k]:.2f} times the usual. "
            )
            sentence += LEARNED if name in learned else doubt
        alarming = is_shifted and name not in learned
        found.append(Finding(test, sentence, alarming, distance, threshold))
    return found
