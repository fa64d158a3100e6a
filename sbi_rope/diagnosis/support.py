"""Which observations have simulations to match them, and how many each rests on."""

from dataclasses import dataclass

import torch
from scipy.stats import binom
from torch import Tensor

from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations, nearest_distances

__all__ = ["Support", "support_of"]

# Share of simulations whose nearest other is farther than what flags an observation.
FLAGGED_SHARE = 0.001
# As far again as the distance that flags.
FAR = 2.0
FEW, MANY_WITH_FEW = 10.0, 0.05
INDISTINCT = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Support:
    """Distances of observations from simulations, and what flags them.

    Attributes:
        distance: To the nearest simulation, in units of the median between
            simulations, ``(n_o,)``.
        limit: The distance above which an observation is flagged.
        chance: The chance that a simulation would be.
    """

    distance: Tensor
    limit: float
    chance: float

    @property
    def flags(self) -> Tensor:
        """Indices of the observations that no simulation matches."""
        return (self.distance > self.limit).nonzero().flatten()

    def findings(self, sizes: Tensor, num_simulations: int) -> list[Finding]:
        """Judge the distances, and the effective sample sizes of the coupling."""
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
            sentence += f" ({shown}); look at them before trusting their posteriors"
        return Finding(
            name="observations no simulation matches",
            value=float(len(flags)),
            threshold=allowed,
            alarming=len(flags) > allowed,
            sentence=f"{sentence}.",
            reason=(
                "Observations are flagged that are farther from their nearest "
                f"simulation than all but {self.chance:.2%} of the simulations are "
                "from their nearest other; alarming above the threshold, the number "
                "flagged by chance in one batch of simulations in a hundred."
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
            sentence=(
                f"Observation {index} is farthest from simulations: "
                f"{float(self.distance[index]):.2g} times as far as is typical between "
                f"simulations, {value:.2g} times the distance that flags."
            ),
            reason=(
                "Alarming above the threshold: among many observations some are "
                "flagged by chance, but none lies in so wide a void."
            ),
        )


def support_of(real: Tensor, simulations: Simulations) -> Support:
    """Compare distances to simulations with those of simulations to one another.

    The simulation itself is left out, so that an observation that is a simulation is
    flagged as often as any other.
    """
    nearest = simulations.nearest
    # An order statistic: the (k+1)-th of n is exceeded with chance (k + 1) / (n + 1).
    k = int(FLAGGED_SHARE * len(nearest))
    unit = float(nearest.median())
    if unit == 0.0:  # most simulations have a twin, as with discrete data
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
        sentence=(
            f"{share:.0%} of the posteriors rest on fewer than {FEW:.0f} simulations; "
            f"the median effective sample size is {float(sizes.median()):.3g}."
        ),
        reason=(
            f"With {FEW:.0f} simulations the centre of a posterior is off by a third "
            "of their spread; alarming above the threshold, where this is no longer "
            "an exception. More simulations or a larger gamma help."
        ),
    )


def _indistinct(sizes: Tensor, num_simulations: int) -> Finding:
    share = float(sizes.median()) / num_simulations
    return Finding(
        name="posteriors like the prior",
        value=share,
        threshold=INDISTINCT,
        alarming=share > INDISTINCT,
        sentence=(
            f"A typical posterior is spread over {share:.0%} of the simulations."
        ),
        reason=(
            "Alarming above the threshold: half of all simulations is hardly less "
            "than the prior. A smaller gamma, or cost_scale='simulated', tells "
            "observations apart."
        ),
    )
