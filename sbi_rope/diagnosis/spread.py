"""Test whether a batch holds a narrower range of parameters than the prior."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._units import divisors
from sbi_rope.diagnosis.implied import resampled
from sbi_rope.diagnosis.prior_shift import PriorShift
from sbi_rope.diagnosis.report import Finding

__all__ = ["FEWEST", "Spread", "spread_of"]

# With fewer observations or calibration pairs, spreads are too uncertain to compare.
FEWEST = 5
NUM_DRAWS = 1000
LEVEL = 0.01


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
        return [
            Finding(
                name=f"narrower than the prior: {name}",
                value=float(self.ratio[k]),
                threshold=float(threshold[k]),
                alarming=bool(self.ratio[k] < threshold[k]),
                concerns="stack and RoPE",
                sentence=_sentence(
                    name,
                    float(self.ratio[k]),
                    narrow=bool(self.ratio[k] < threshold[k]),
                    tuned=tuned,
                ),
                reason=self._reason(k),
            )
            for k, name in enumerate(names)
        ]

    def _reason(self, k: int) -> str:
        what = "Alarming below the threshold, a ratio of standard deviations"
        chance = (
            "one in a hundred batches that are drawn from the prior has less than "
            f"{float(self.chance[k]):.2f} in one of its parameters"
        )
        if self.error is not None:
            what += ". It is the product of two numbers"
            chance += (
                ", and errors of the tuned embedding net, as seen on calibration pairs "
                "that it was not trained on, may lower the ratio by a factor of "
                f"{float(self.error[k]):.2f}"
            )
        return (
            f"{what}: {chance}. In RoPE, a smaller tau trusts the prior less. Scores "
            "and calibration on pairs of the whole prior need not hold for this batch."
        )


def spread_of(
    shift: PriorShift, theta: Tensor, *, theta_cal: Tensor | None = None
) -> Spread:
    r"""Compare the spread of implied parameters with that of a batch from the prior.

    Each observation implies a mean parameter, see
    :func:`~sbi_rope.diagnosis.implied.implied_by`. The statistic is the standard
    deviation of these means over the batch. The width of each posterior, which blurs
    the distribution in :func:`~sbi_rope.diagnosis.prior_shift.prior_shift`, is not in
    it. A batch with a quarter of the prior's spread has about half of the spread of
    means in the linear-Gaussian problem of the tests, because the means of single
    observations vary with their noise too.

    The threshold comes from 1000 batches of the same size, drawn from simulations that
    take the place of observations, as tuning would move them and unchanged. Whichever
    is lower counts. If g was tuned on few pairs it may squeeze all observations
    together. Held-out pairs show how far the means spread under g: they are regressed
    on the true parameter, which gives the spread that a batch from the prior would
    have. If the 1 % quantile of its bootstrap (divided among the parameters, too) is
    below that of simulations, the threshold is lowered by the same factor.

    In the linear-Gaussian problem, with a new g for each batch, this many of 50 batches
    of the prior and of 10 batches with a quarter or half of its spread are alarming in
    at least one parameter:

    ========== ===== ============ === ======= ====
    parameters pairs observations all quarter half
    ========== ===== ============ === ======= ====
    2          50    1000         0   10      10
    2          50    100          0   10      10
    2          20    1000         2   10      7
    10         50    1000         0   10      10
    ========== ===== ============ === ======= ====

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

    Args:
        shift: With what held-out pairs imply.
        theta: The parameters of these pairs, shape ``(n, d)``.
        variance: The variance of each parameter in the prior, shape ``(d,)``.
        level: The quantile of the bootstrap over people.
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


def _sentence(name: str, ratio: float, *, narrow: bool, tuned: bool) -> str:
    size = (
        f"what its observations imply spreads {ratio:.2f} times as far as for a batch "
        "of the prior"
    )
    if not narrow:
        return f"No sign that the batch has a narrower range of {name}: {size}."
    sentence = f"The batch seems to have a narrower range of {name} than the prior"
    if not tuned:
        return (
            f"{sentence}: {size}. But no calibration pairs have tuned the embedding "
            "net, and then misspecification looks the same."
        )
    return (
        f"{sentence}: {size} (the true range is narrower still, because observations "
        "are noisy)."
    )
