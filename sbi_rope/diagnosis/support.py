"""Test whether observations have simulations near them, and how many."""

from dataclasses import dataclass

import torch
from scipy.stats import binom
from torch import Tensor

from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations, nearest_distances

__all__ = ["Support", "support_of"]

# An observation is flagged if its nearest simulation is farther away than the nearest
# neighbours of all simulations but this share.
FLAGGED_SHARE = 0.001
# Twice the distance above which an observation is flagged.
FAR = 2.0
FEW, MANY_WITH_FEW = 10.0, 0.05
INDISTINCT = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Support:
    """Distances of observations from simulations, and the limit for flags.

    Attributes:
        distance: Distance to the nearest simulation, ``(n_o,)``. The unit is the median
            distance from a simulation to its nearest neighbour.
        limit: The distance above which an observation is flagged.
        chance: The probability that a simulation would be flagged.
    """

    distance: Tensor
    limit: float
    chance: float

    @property
    def flags(self) -> Tensor:
        """Indices of the observations that have no simulation near them."""
        return (self.distance > self.limit).nonzero().flatten()

    def findings(self, sizes: Tensor, num_simulations: int) -> list[Finding]:
        """Return findings about the distances and the effective sample sizes."""
        return [
            self._unmatched(),
            self._farthest(),
            _few(sizes),
            _indistinct(sizes, num_simulations),
        ]

    def _unmatched(self) -> Finding:
        count, flags = len(self.distance), self.flags.tolist()
        allowed = float(binom.ppf(0.99, count, self.chance))
        sentence = f"{len(flags)} of {count} observations have no simulation near them"
        if flags:
            shown = ", ".join(map(str, flags[:10])) + (", ..." if flags[10:] else "")
            sentence += f" ({shown}); look at them before you trust their posteriors"
        return Finding(
            name="observations no simulation matches",
            value=float(len(flags)),
            threshold=allowed,
            alarming=len(flags) > allowed,
            concerns="RoPE",
            sentence=f"{sentence}.",
            reason=(
                "An observation is flagged if it is farther from its nearest "
                f"simulation than all but {self.chance:.2%} of the simulations are "
                "from their nearest neighbours. Alarming above the threshold: one "
                "batch of simulations in a hundred has more flags by chance."
            ),
        )

    def _farthest(self) -> Finding:
        index = int(self.distance.argmax())
        value = float(self.distance[index]) / self.limit
        return Finding(
            name="farthest observation",
            value=value,
            threshold=FAR,
            alarming=value > FAR,
            concerns="RoPE",
            sentence=(
                f"Observation {index} is farthest from simulations: "
                f"{float(self.distance[index]):.2g} times as far as is typical between "
                f"simulations, and {value:.2g} times the limit for a flag."
            ),
            reason=(
                "Alarming above the threshold: among many observations some are "
                "flagged by chance, but hardly one is so far away by chance."
            ),
        )


def support_of(real: Tensor, simulations: Simulations) -> Support:
    """Compare distances to simulations with those of simulations to one another.

    The distance of a simulation to itself is left out, so that a simulation that takes
    the place of an observation is flagged with the stated probability.
    """
    nearest = simulations.nearest
    # A new value exceeds the (k+1)-th largest of n with probability (k + 1) / (n + 1).
    k = int(FLAGGED_SHARE * len(nearest))
    unit = float(nearest.median())
    if unit == 0.0:  # most simulations are the same as another, as with discrete data
        unit = float(nearest.mean()) or 1.0
    limit = float(nearest.sort(descending=True).values[k])
    smallest = torch.finfo(torch.float64).tiny
    return Support(
        distance=nearest_distances(real, simulations.embedded) / unit,
        limit=max(limit / unit, smallest),
        chance=(k + 1) / (len(nearest) + 1),
    )


def _few(sizes: Tensor) -> Finding:
    share = float((sizes < FEW).double().mean())
    return Finding(
        name="observations with few simulations",
        value=share,
        threshold=MANY_WITH_FEW,
        alarming=share > MANY_WITH_FEW,
        concerns="RoPE",
        sentence=(
            f"{share:.0%} of the posteriors use fewer than {FEW:.0f} simulations; "
            f"the median effective sample size is {float(sizes.median()):.3g}."
        ),
        reason=(
            f"With {FEW:.0f} simulations the centre of a posterior is off by a third "
            "of their spread. Alarming above the threshold, because this should be an "
            "exception. More simulations or a larger gamma help."
        ),
    )


def _indistinct(sizes: Tensor, num_simulations: int) -> Finding:
    share = float(sizes.median()) / num_simulations
    remedy = "A smaller gamma separates the observations."
    if len(sizes) == 1:
        # The sums of the columns are given, and a single row has to have them.
        remedy = (
            "At tau=1 a single observation has the prior for any gamma. Couple it with "
            "others, or use `stack(rope)`, which needs no batch."
        )
    return Finding(
        name="posteriors like the prior",
        value=share,
        threshold=INDISTINCT,
        alarming=share > INDISTINCT,
        concerns="RoPE",
        sentence=(
            f"A typical posterior is spread over {share:.0%} of the simulations."
        ),
        reason=(
            "Alarming above the threshold: a posterior over half of all simulations is "
            f"almost the prior. {remedy}"
        ),
    )
