"""Compare the parameters that the batch implies with the prior, and with the pairs."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._prior import divisors
from sbi_rope._sbi import TrainedNPE
from sbi_rope.coupling import Coupling
from sbi_rope.data import Counts
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.residuals import CrossFitted
from sbi_rope.diagnosis.simulations import (
    Implied,
    Simulations,
    couple_by_itself,
    implied_by,
    resampled,
)
from sbi_rope.rope import RoPE

__all__ = [
    "FEWEST",
    "PriorShift",
    "Spread",
    "also_in_pairs",
    "implied_by_pairs",
    "prior_shift",
    "spread_of",
]

# The largest number of simulations that take the place of observations, and the number
# of batches that are drawn from them.
MAX_PLAYERS, NUM_DRAWS = 1000, 1000
LEVEL = 0.01
ERROR_QUANTILE = 0.95
# With fewer observations or calibration pairs, spreads are too uncertain to compare.
FEWEST = 5
UNTUNED = (
    "But no calibration pairs have tuned the embedding net, and then misspecification "
    "looks the same."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class PriorShift:
    """The parameters that a batch implies.

    Attributes:
        distance: Kolmogorov-Smirnov distance between the parameters of the batch and of
            one that follows the prior, ``(d,)``.
        chance: The limits that one in a hundred batches from the prior exceeds in at
            least one parameter, ``(d,)``.
        error: The distance by which errors of g move calibration pairs, ``(d,)``; None
            if it is unknown.
        batch: What each observation of the batch implies.
        expected: What simulations imply that take the place of observations: as tuning
            would move them, and unchanged. Without tuning the two are the same, and
            there is only one.
        pairs: What held-out calibration pairs imply, if there are any.
        held_out: These pairs.
    """

    distance: Tensor
    chance: Tensor
    error: Tensor | None
    batch: Implied
    expected: tuple[Implied, ...]
    pairs: Implied | None
    held_out: CrossFitted | None

    @property
    def threshold(self) -> Tensor:
        """The distance above which a shift is alarming, ``(d,)``."""
        return self.chance if self.error is None else self.chance + self.error

    def findings(
        self, simulations: Simulations, names: Sequence[str], notes: list[str]
    ) -> list[Finding]:
        """Return a finding for each parameter whose threshold can be exceeded.

        A distance is at most one. The other parameters are noted.
        """
        theta = simulations.theta
        std = divisors(theta.std(dim=0))
        mean, spread = _moments(theta, self.batch.weights)
        usual_mean, usual_spread = _moments(theta, self.expected[0].weights)
        move = ((mean - usual_mean) / std).tolist()
        ratio = (spread / divisors(usual_spread)).tolist()
        is_shifted = (self.distance > self.threshold).tolist()
        found, left_out = [], []
        for k, name in enumerate(names):
            if self.threshold[k] >= 1.0:
                left_out.append(name)
                continue
            where = (
                f"the mean of {name} is {abs(move[k]):.2f} prior standard deviations "
                f"{'higher' if move[k] > 0 else 'lower'} and its spread {ratio[k]:.2f} "
                "times what a batch of the prior would give"
            )
            seems = f"The batch seems to have other values of {name} than the prior"
            if not is_shifted[k]:
                sentence = f"No sign that {name} is shifted against the prior: {where}."
            elif not simulations.tuned:
                sentence = f"{seems}: {where}. {UNTUNED}"
            else:
                drawn = "(understated: observations are drawn to the prior)"
                sentence = f"{seems}: {where} {drawn}."
            found.append(
                Finding(
                    name=f"prior shift: {name}",
                    value=float(self.distance[k]),
                    threshold=float(self.threshold[k]),
                    alarming=is_shifted[k],
                    concerns="stack and RoPE",
                    sentence=sentence,
                    reason=_reason(
                        "Alarming above the threshold, a Kolmogorov-Smirnov distance",
                        f"more than {float(self.chance[k]):.2f}",
                        "sum of two numbers",
                        "add {:.2f}",
                        None if self.error is None else self.error[k],
                    ),
                )
            )
        if left_out:
            verb = "is" if len(left_out) == 1 else "are"
            notes.append(
                f"Whether {', '.join(left_out)} {verb} shifted against the prior was "
                "not tested: with so few observations or calibration pairs, even the "
                "largest distance would be no sign of it."
            )
        return found


def prior_shift(
    real: Tensor, simulations: Simulations, *, held_out: CrossFitted | None = None
) -> PriorShift:
    """Compare the parameters implied by a batch with those implied by simulations.

    The mean of :func:`implied_by`'s weights over the batch estimates the distribution
    of its parameters. The estimate is blurred by gamma, by the posterior of each
    observation, which is drawn to the prior, and by tuning, so that it understates a
    shift: in the linear-Gaussian problem of the tests, a true mean of 1.14 is estimated
    as 0.81 in two dimensions and 0.37 in ten, and 0.63 and 0.31 after tuning.

    The batch is compared with simulations that take the place of observations, both
    unchanged and as tuning would move them. None of them is matched with itself. If g
    was tuned on few pairs and misses its targets, the batch looks shifted too.
    Therefore the same distance is measured between calibration pairs that g has not
    seen and their targets, and the 95 % quantile of its bootstrap is added to the
    threshold. A strong shift of one parameter also moves the parameters that it is
    confounded with.
    """
    embedded = simulations.embedded
    coupling = couple_by_itself(simulations)
    batch = implied_by(coupling, real, simulations)
    players = torch.arange(min(len(simulations), MAX_PLAYERS))
    averaged = simulations.averaged[players]
    expected = implied_by(coupling, averaged, simulations, own=players)
    # A g that was trained little averages less over noise. The threshold allows for the
    # two ends, full averaging and none.
    ends = [expected]
    if simulations.tuned:
        ends.append(implied_by(coupling, embedded[players], simulations, own=players))
    level = 1.0 - LEVEL / simulations.theta.shape[1]
    chances = [
        _draws(end.functions, expected.functions, size=len(real)).quantile(level, dim=0)
        for end in ends
    ]
    pairs, error = None, None
    if held_out is not None:
        pairs = implied_by(coupling, held_out.embedded, simulations)
        error = _errors_of_g(coupling, pairs, held_out, simulations)
    return PriorShift(
        distance=_distance(batch, expected),
        chance=torch.stack(chances).amax(dim=0),
        error=error,
        batch=batch,
        expected=tuple(ends),
        pairs=pairs,
        held_out=held_out,
    )


def _errors_of_g(
    coupling: Coupling, found: Implied, held_out: CrossFitted, simulations: Simulations
) -> Tensor:
    """Return how far errors of g move the parameters of unseen pairs, shape (d,)."""
    targets = simulations.average(held_out.targets)
    wanted = implied_by(coupling, targets, simulations)
    # With few people the errors could be small by chance, hence a bootstrap.
    difference = held_out.of_people(found.functions - wanted.functions)
    gaps = resampled(difference, len(difference), num_draws=NUM_DRAWS)
    return gaps.abs().amax(dim=-1).quantile(ERROR_QUANTILE, dim=0)


def _draws(functions: Tensor, expected: Tensor, *, size: int) -> Tensor:
    """Return distances for batches of simulations, shape ``(draws, d)``."""
    # The expectation is itself a mean over simulations, with its own uncertainty.
    batch = resampled(functions, size, num_draws=NUM_DRAWS)
    reference = resampled(expected, len(expected), num_draws=NUM_DRAWS)
    return _largest_gap(batch, reference)


def _distance(a: Implied, b: Implied) -> Tensor:
    return _largest_gap(a.functions.mean(dim=0), b.functions.mean(dim=0))


def _largest_gap(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).abs().amax(dim=-1)


def _moments(theta: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    mean = weights @ theta
    return mean, (weights @ (theta - mean).square()).sqrt()


def _reason(
    what: str, limit: str, joined: str, change: str, error: Tensor | None
) -> str:
    """Say where a threshold comes from: chance, and errors of g if they are known."""
    chance = (
        f"one in a hundred batches that are drawn from the prior has {limit} in one of "
        "its parameters"
    )
    if error is not None:
        what += f". It is the {joined}"
        chance += (
            ", and errors of the tuned embedding net, as seen on calibration pairs "
            f"that it was not trained on, may {change.format(float(error))}"
        )
    return f"{what}: {chance}. In RoPE, a smaller tau trusts the prior less."


# Spread -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Spread:
    """How far the parameters that observations imply spread, compared with the prior.

    Attributes:
        ratio: Spread of the batch, as a multiple of that of a batch from the prior,
            ``(d,)``.
        chance: The ratios that one in a hundred batches from the prior falls below in
            at least one parameter, ``(d,)``.
        error: The factor by which errors of g may lower the ratio, at most one,
            ``(d,)``; None if it is unknown.
    """

    ratio: Tensor
    chance: Tensor
    error: Tensor | None

    @property
    def threshold(self) -> Tensor:
        """The ratio below which a batch is alarmingly narrow, ``(d,)``."""
        return self.chance if self.error is None else self.chance * self.error

    def findings(self, names: Sequence[str], *, tuned: bool) -> list[Finding]:
        """Return a finding for each parameter."""
        threshold = self.threshold
        found = []
        for k, name in enumerate(names):
            ratio = float(self.ratio[k])
            is_narrow = bool(self.ratio[k] < threshold[k])
            size = (
                f"what its observations imply spreads {ratio:.2f} times as far as for "
                "a batch of the prior"
            )
            seems = f"The batch seems to have a narrower range of {name} than the prior"
            if not is_narrow:
                sentence = (
                    f"No sign that the batch has a narrower range of {name}: {size}."
                )
            elif not tuned:
                sentence = f"{seems}: {size}. {UNTUNED}"
            else:
                still = (
                    "the true range is narrower still, because observations are noisy"
                )
                sentence = f"{seems}: {size} ({still})."
            reason = _reason(
                "Alarming below the threshold, a ratio of standard deviations",
                f"less than {float(self.chance[k]):.2f}",
                "product of two numbers",
                "lower the ratio by a factor of {:.2f}",
                None if self.error is None else self.error[k],
            )
            found.append(
                Finding(
                    name=f"narrower than the prior: {name}",
                    value=ratio,
                    threshold=float(threshold[k]),
                    alarming=is_narrow,
                    concerns="stack and RoPE",
                    sentence=sentence,
                    reason=f"{reason} Scores and calibration on pairs of the whole "
                    "prior need not hold for this batch.",
                )
            )
        return found


def spread_of(
    shift: PriorShift, theta: Tensor, *, theta_cal: Tensor | None = None
) -> Spread:
    r"""Compare the spread of implied parameters with that of a batch from the prior.

    Each observation implies a mean parameter. The statistic is the standard deviation
    of these means over the batch. The width of each posterior, which blurs the
    distribution in :func:`prior_shift`, is not in it. A batch with a quarter of the
    prior's spread has about half of the spread of means in the linear-Gaussian problem
    of the tests, because the means of single observations vary with their noise too.

    The threshold comes from 1000 batches of the same size, drawn from simulations that
    take the place of observations, as tuning would move them and unchanged. Whichever
    is lower counts. If g was tuned on few pairs it may squeeze all observations
    together. Held-out pairs show how far the means spread under g: they are regressed
    on the true parameter, which gives the spread that a batch from the prior would
    have. If the 1 % quantile of its bootstrap (divided among the parameters, too) is
    below that of simulations, the threshold is lowered by the same factor.

    Args:
        shift: What the batch, simulations and held-out pairs imply.
        theta: The parameters of the simulations, shape ``(n_s, d)``.
        theta_cal: The parameters of the held-out pairs, shape ``(n_c, d)``, if there
            are any.
    """
    batch, (reference, *_) = shift.batch.means, shift.expected
    usual = divisors(reference.means.std(dim=0))
    level = LEVEL / theta.shape[1]
    again = divisors(_spreads(reference.means, len(reference.means)))
    chances = [
        (_spreads(end.means, len(batch)) / again).quantile(level, dim=0)
        for end in shift.expected
    ]
    error = None
    if shift.pairs is not None and theta_cal is not None:
        predicted = _predicted(shift, theta_cal, theta.var(dim=0), level=level)
        error = (predicted / usual).clamp_max(1.0)
    return Spread(
        ratio=batch.std(dim=0) / usual,
        chance=torch.stack(chances).amin(dim=0),
        error=error,
    )


def _spreads(means: Tensor, size: int) -> Tensor:
    """Return standard deviations of batches drawn from rows, ``(draws, d)``."""
    centred = means - means.mean(dim=0)
    moments = torch.stack([centred, centred.square()], dim=1)
    mean, square = resampled(moments, size, num_draws=NUM_DRAWS).unbind(dim=1)
    variance = (square - mean.square()) * size / (size - 1)
    return variance.clamp_min(0.0).sqrt()


def _predicted(
    shift: PriorShift, theta: Tensor, variance: Tensor, *, level: float
) -> Tensor:
    """Return how far implied means spread at least for a batch of the prior, ``(d,)``.

    It is a quantile of a bootstrap over people. Theta are the parameters of the pairs,
    and the variance is that of the prior.
    """
    assert shift.pairs is not None
    assert shift.held_out is not None
    means = shift.pairs.means
    x, y = theta - theta.mean(dim=0), means - means.mean(dim=0)
    moments = torch.stack([x, y, x * x, x * y, y * y], dim=1)
    moments = shift.held_out.of_people(moments)
    n = len(moments)
    draws = resampled(moments, n, num_draws=NUM_DRAWS)
    mean_x, mean_y, xx, xy, yy = draws.unbind(dim=1)
    var_x = divisors((xx - mean_x.square()).clamp_min(0.0))
    cov = xy - mean_x * mean_y
    slope = cov / var_x
    left = (yy - mean_y.square() - slope * cov).clamp_min(0.0) * n / (n - 2)
    spread = (slope.square() * variance + left).sqrt()
    return spread.quantile(level, dim=0)


# The pairs ----------------------------------------------------------------------------


def implied_by_pairs(rope: RoPE, npe: TrainedNPE, simulations: Simulations) -> Implied:
    """Return what each person or specimen of the pairs implies.

    Their labels are not used: an observation is drawn to the prior, and moves the
    parameters that are confounded. Those of the pairs do so as those of the batch do.
    """
    x, group = rope.pairs.x, rope.pairs.group
    embedded = npe.embed("x", x, rope.tuned_embedding_net).detach().cpu().double()
    found = implied_by(couple_by_itself(simulations), embedded, simulations)
    people = Counts(torch.ones(len(x)), group.cpu())
    return Implied(
        weights=found.weights,
        functions=people.of_groups(found.functions)[0],
        means=people.of_groups(found.means)[0],
    )


def also_in_pairs(
    shift: PriorShift, pairs: Implied, names: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of findings about the prior that the pairs show as well.

    A batch is shifted as the pairs are if its parameters are closer to those of the
    pairs than to the prior, in the Kolmogorov-Smirnov distance of the finding. It is as
    narrow as the pairs if the same is true of its spread, by ratios.
    """
    batch, prior = shift.batch, shift.expected[0]
    is_shifted = _distance(batch, pairs) < _distance(batch, prior)
    is_narrow = torch.zeros_like(is_shifted)
    if len(batch.means) > 1 and len(pairs.means) > 1:
        is_narrow = _log_ratio(batch, pairs) < _log_ratio(batch, prior)
    tests = (("prior shift", is_shifted), ("narrower than the prior", is_narrow))
    return tuple(
        f"{test}: {name}"
        for test, found in tests
        for name, is_found in zip(names, found, strict=True)
        if is_found
    )


def _log_ratio(a: Implied, b: Implied) -> Tensor:
    tiny = torch.finfo(a.means.dtype).tiny
    spreads = [one.means.std(dim=0).clamp_min(tiny) for one in (a, b)]
    return (spreads[0].log() - spreads[1].log()).abs()
