"""Compare the parameters that the batch implies with the prior."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._prior import divisors
from sbi_rope.coupling import Coupling
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.residuals import CrossFitted
from sbi_rope.diagnosis.simulations import (
    Implied,
    Simulations,
    couple_by_itself,
    implied_by,
    resampled,
)

__all__ = [
    "PriorShift",
    "prior_shift",
]

# The largest number of simulations that take the place of observations, and the number
# of batches that are drawn from them.
MAX_PLAYERS, NUM_DRAWS = 1000, 1000
LEVEL = 0.01
ERROR_QUANTILE = 0.95
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
    """

    distance: Tensor
    chance: Tensor
    error: Tensor | None
    batch: Implied
    expected: tuple[Implied, ...]

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
                    reason=self._reason(k),
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

    def _reason(self, k: int) -> str:
        """Say where a threshold comes from: chance, and errors of g if known."""
        what = "Alarming above the threshold, a Kolmogorov-Smirnov distance"
        chance = (
            "one in a hundred batches that are drawn from the prior has more than "
            f"{float(self.chance[k]):.2f} in one of its parameters"
        )
        if self.error is not None:
            what += ". It is the sum of two numbers"
            chance += (
                ", and errors of the tuned embedding net, as seen on calibration pairs "
                f"that it was not trained on, may add {float(self.error[k]):.2f}"
            )
        return f"{what}: {chance}. In RoPE, a smaller tau trusts the prior less."


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
    error = None
    if held_out is not None:
        error = _errors_of_g(coupling, held_out, simulations)
    return PriorShift(
        distance=_distance(batch, expected),
        chance=torch.stack(chances).amax(dim=0),
        error=error,
        batch=batch,
        expected=tuple(ends),
    )


def _errors_of_g(
    coupling: Coupling, held_out: CrossFitted, simulations: Simulations
) -> Tensor:
    """Return how far errors of g move the parameters of unseen pairs, shape (d,)."""
    targets = simulations.average(held_out.targets)
    found = implied_by(coupling, held_out.embedded, simulations)
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
