"""Test whether a batch is unlike simulations or pairs, and has simulations near it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from scipy.stats import binom
from torch import Tensor, nn

from sbi_rope._sbi import squared_mmd
from sbi_rope._standardisation import FAR, deviations
from sbi_rope._statistics import LEVEL, TwoSampleTest
from sbi_rope.diagnosis.report import UNLIKE_PAIRS, Finding
from sbi_rope.diagnosis.simulations import Simulations, nearest_distances

__all__ = [
    "Support",
    "far_findings",
    "labelled_findings",
    "misspecification_findings",
    "mmd_test",
    "support_of",
]

# The largest numbers of observations and simulations in one MMD, whose cost is
# quadratic.
MAX_OBSERVATIONS, MAX_SIMULATIONS = 200, 400
NUM_DRAWS = 200
# An observation is flagged if its nearest simulation is farther away than the nearest
# neighbours of all simulations but this share.
FLAGGED_SHARE = 0.001
# Twice the distance above which an observation is flagged.
FAR_AWAY = 2.0
FEW, MANY_WITH_FEW = 10.0, 0.05
INDISTINCT = 0.5


@dataclass(frozen=True, kw_only=True)
class MMDTest:
    """The outcome of :func:`mmd_test`.

    Attributes:
        mmd: Squared MMD between the batch and simulations.
        usual: The median of the squared MMD for batches of simulations.
        p_value: The probability that a batch of simulations has an MMD as large.
    """

    mmd: float
    usual: float
    p_value: float


def mmd_test(batch: Tensor, simulated: Tensor, *, null: Tensor) -> MMDTest:
    r"""Test whether a batch is like simulations, with sbi's MMD.

    sbi's own p-value compares an MMD of n against m points with MMDs of n against
    m - n points, which are larger on average. Here the numbers of points are the same.

    References:
        | Detecting Model Misspecification in Amortized Bayesian Inference with Neural
          Networks (Schmitt et al., 2023)
        | https://arxiv.org/abs/2112.08866
    At most 200 random rows of the batch ``(n_o, l)`` are used. Under the null
    hypothesis, it has embeddings as in ``null``, one for each simulation ``(n_s, l)``.
    """
    num_real = min(len(batch), MAX_OBSERVATIONS, len(simulated) // 3)
    num_simulated = min(MAX_SIMULATIONS, len(simulated) - num_real)
    chosen = batch[torch.randperm(len(batch))[:num_real]]
    usual = torch.empty(NUM_DRAWS, dtype=torch.float64)
    for i in range(NUM_DRAWS):
        order = torch.randperm(len(simulated))[: num_real + num_simulated]
        real, other = order[:num_real], order[num_real:]
        usual[i] = squared_mmd(null[real], simulated[other])
    value = squared_mmd(
        chosen, simulated[torch.randperm(len(simulated))[:num_simulated]]
    )
    return MMDTest(
        mmd=value,
        usual=float(usual.median()),
        # The batch itself counts as one of the draws, so that p is never 0.
        p_value=(1 + int((usual >= value).sum())) / (1 + NUM_DRAWS),
    )


def misspecification_findings(
    before: Tensor, after: Tensor | None, simulations: Simulations
) -> list[Finding]:
    """Test h(x_o), and g(x_o) if there is a tuned g, against h(x_s)."""
    simulated = simulations.embedded
    first = mmd_test(before, simulated, null=simulated)
    tuned = after is not None
    if first.p_value < LEVEL:
        sentence = (
            "As NPE sees it, the batch is unlike simulations: its squared MMD is "
            f"{_ratio(first)} that of a batch of simulations. The simulator is "
            "misspecified, or the batch has other parameters than the prior; this "
            "test cannot tell which."
        )
        if tuned:
            sentence += " The calibration pairs are there to repair this."
    else:
        sentence = (
            "No sign that NPE sees the batch as unlike simulations: "
            f"{first.p_value:.0%} of batches of simulations differ from others as much."
        )
    findings = [_finding("before", first, sentence, is_expected=tuned)]
    if after is None:
        return findings
    second = mmd_test(after, simulated, null=simulations.averaged)
    course = f"{first.mmd:.2g} before tuning, {second.mmd:.2g} after"
    if second.p_value < LEVEL:
        sentence = (
            "After tuning the batch is unlike simulations: its squared MMD is "
            f"{_ratio(second)} what is usual ({course}). If the batch is shifted or "
            "narrower than the prior, this may be the reason. Otherwise there may be "
            "too few calibration pairs, or they are unlike the batch."
        )
    else:
        sentence = (
            "No sign that the batch is less like simulations after tuning than "
            "averaging over the simulator's noise explains: "
            f"{second.p_value:.0%} of batches of simulations differ as much (squared "
            f"MMD {course})."
        )
    return [*findings, _finding("after", second, sentence)]


def _finding(
    when: Literal["before", "after"],
    test: MMDTest,
    sentence: str,
    *,
    is_expected: bool = False,
) -> Finding:
    alarming = test.p_value < LEVEL
    return Finding(
        name=f"misspecification {when} tuning",
        value=test.p_value,
        threshold=LEVEL,
        alarming=alarming,
        is_p_value=True,
        is_expected=alarming and is_expected,
        concerns="NPE" if when == "before" else "RoPE",
        sentence=sentence,
        reason=(
            "Alarming below the threshold: one batch of simulations in a hundred falls "
            "there."
        ),
    )


def _ratio(test: MMDTest) -> str:
    ratio = test.mmd / max(test.usual, 1e-300)
    return f"{ratio:.0f} times" if ratio >= 10 else f"{ratio:.1f} times"


def labelled_findings(
    test: TwoSampleTest | None, names: Sequence[str], notes: list[str]
) -> list[Finding]:
    """Say whether the batch is like the pairs, or note why this was not tested."""
    if test is None:
        notes.append(
            "Whether the batch is like the calibration pairs was not tested, which "
            "needs at least five observations and five pairs with different parameters "
            "(or groups)."
        )
        return []
    size = (
        f"its observations are {test.spread:.2f} times as far apart as those of the "
        "pairs"
    )
    if test.is_different:
        found = test.parameters(names)
        where = f", and its parameters differ in {', '.join(found)}" if found else ""
        sentence = (
            f"As NPE sees it, the batch differs from the calibration pairs: {size}"
            f"{where}. The weights of a stack, its scores and its calibration were "
            "found on the pairs, and need not hold for this batch. The same is true of "
            "what sets with a guarantee promise. Label some observations like those of "
            "the batch."
        )
    else:
        sentence = (
            "No sign that the batch differs from the calibration pairs, as NPE sees "
            f"them: {size}."
        )
    finding = Finding(
        name=UNLIKE_PAIRS,
        value=test.p_value,
        threshold=LEVEL,
        alarming=test.is_different,
        is_p_value=True,
        concerns="stack and RoPE",
        sentence=sentence,
        reason=(
            "Alarming below the threshold (the p-value of an energy test): one batch "
            "in a hundred that is drawn like the pairs falls there."
        ),
    )
    return [finding]


def far_findings(embedding_net: nn.Module, x_o: Tensor) -> list[Finding]:
    """Return a finding about the farthest entry of x, if NPE standardises x."""
    far = deviations(embedding_net, x_o)
    if far is None:
        return []
    far = far.flatten(1)
    row, column = divmod(int(far.argmax()), far.shape[1])
    value = float(far.max())
    return [
        Finding(
            name="entries far from simulations",
            value=value,
            threshold=FAR,
            alarming=value > FAR,
            concerns="stack and RoPE",
            sentence=(
                f"Entry {column} of observation {row} is {value:.2g} standard "
                "deviations of the simulations away from their mean, and none is "
                "farther."
            ),
            reason=(
                "Alarming above the threshold, which is far beyond any error of a "
                "simulator. Above it, the units may differ, and the answer of NPE is "
                "arbitrary. Entries that never vary in simulations are ignored."
            ),
        )
    ]


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
            threshold=FAR_AWAY,
            alarming=value > FAR_AWAY,
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
