"""Test whether observations have simulations near them, and how many."""

from typing import NamedTuple

import torch
from scipy.stats import binom
from torch import Tensor

from sbi_rope.coupling import Coupling
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations, nearest_distances

__all__ = ["effective_sizes", "support_of", "unmatched"]

# An observation is flagged if its nearest simulation is farther away than the nearest
# neighbours of all simulations but this share.
FLAGGED_SHARE = 0.001
# Among many observations some are flagged by chance, but hardly one is this many times
# as far away as the limit.
FAR_AWAY = 2.0
# With ten simulations the centre of a posterior is off by a third of their spread,
# which should be an exception.
FEW, MANY_WITH_FEW = 10.0, 0.05
# A posterior over half of all simulations is almost the prior.
INDISTINCT = 0.5


class Support(NamedTuple):
    """Distances of observations from simulations, and the limit for flags.

    ``distance``, ``(n_o,)``, is that to the nearest simulation. The unit is the median
    distance from a simulation to its nearest neighbour. ``chance`` is the probability
    that a simulation in place of an observation is farther away than ``limit``.
    """

    distance: Tensor
    limit: float
    chance: float

    @property
    def flags(self) -> Tensor:
        """Indices of the observations that have no simulation near them."""
        return (self.distance > self.limit).nonzero().flatten()


def support_of(real: Tensor, simulations: Simulations) -> Support:
    """Compare distances to simulations with those of simulations to one another.

    The distance of a simulation to itself is left out, so that a simulation that takes
    the place of an observation is flagged with the stated probability. A tuned g
    averages over the simulator's noise, and may put observations between simulations,
    such as between the categories of an entry. The limit allows for that.
    """
    embedded = simulations.embedded
    nearest = nearest_distances(embedded, embedded, others=True)
    # A new value exceeds the (k+1)-th largest of n with probability (k + 1) / (n + 1).
    k = int(FLAGGED_SHARE * len(nearest))
    unit = float(nearest.median())
    if unit == 0.0:  # most simulations are the same as another, as with discrete data
        unit = float(nearest.mean()) or 1.0
    averaged = nearest_distances(simulations.averaged, embedded, others=True)
    ends = torch.stack([nearest, averaged]).sort(dim=1, descending=True).values
    limit = float(ends[:, k].max())
    smallest = torch.finfo(torch.float64).tiny
    return Support(
        distance=nearest_distances(real, embedded) / unit,
        limit=max(limit / unit, smallest),
        chance=(k + 1) / (len(nearest) + 1),
    )


def unmatched(support: Support) -> Finding:
    """Say how many observations have no simulation near them.

    One batch of simulations in a hundred has more flags than the threshold. A single
    observation that is very far away is an alarm by itself.
    """
    count, flags = len(support.distance), support.flags.tolist()
    value, threshold = float(len(flags)), float(binom.ppf(0.99, count, support.chance))
    index = int(support.distance.argmax())
    ratio = float(support.distance[index]) / support.limit
    sentence = (
        f"{len(flags)} of {count} observations have no simulation near them (by chance "
        f"up to {threshold:.0f}), and observation {index} is the farthest, at "
        f"{ratio:.2g} times the limit."
    )
    if value <= threshold and ratio > FAR_AWAY:
        value, threshold = ratio, FAR_AWAY
    if alarming := value > threshold:
        shown = ", ".join(map(str, flags[:10])) + (", ..." if flags[10:] else "")
        sentence += f" Look at {shown} before you trust RoPE's posteriors there."
    name = "observations no simulation matches"
    return Finding(name, sentence, alarming, value, threshold)


def effective_sizes(coupling: Coupling, num_simulations: int) -> Finding:
    """Say whether posteriors of RoPE use very few simulations, or almost all."""
    sizes = coupling.effective_sample_size.cpu().double()
    share, median = float((sizes < FEW).double().mean()), float(sizes.median())
    sentence = (
        f"A typical posterior of RoPE uses {median:.3g} of {num_simulations} "
        f"simulations, and {share:.0%} use fewer than {FEW:.0f}."
    )
    value, threshold = share, MANY_WITH_FEW
    if share > MANY_WITH_FEW:
        sentence += " Raise `num_simulations` or gamma."
    elif median > INDISTINCT * num_simulations:
        value, threshold = median / num_simulations, INDISTINCT
        sentence += " This is almost the prior. " + (
            "A smaller gamma separates the observations."
            if len(sizes) > 1
            # The sums of the columns are given, and a single row has to have them.
            else "At tau=1 a single observation has the prior for any gamma. Couple it "
            "with others, or use `stack(rope)`, which needs no batch."
        )
    if not coupling.converged:
        sentence += " The coupling has not converged, so that this is approximate."
    name, alarming = "simulations behind each posterior", value > threshold
    return Finding(name, sentence, alarming, value, threshold)
