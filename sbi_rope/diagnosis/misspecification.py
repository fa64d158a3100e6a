"""Test whether the batch differs from simulations, before tuning and after."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._sbi import squared_mmd
from sbi_rope.diagnosis.report import Finding
from sbi_rope.diagnosis.simulations import Simulations

__all__ = ["MMDTest", "misspecification_findings", "mmd_test"]

# The largest numbers of observations and simulations in one MMD, whose cost is
# quadratic.
MAX_OBSERVATIONS, MAX_SIMULATIONS = 200, 400
NUM_DRAWS = 200
LEVEL = 0.01
REASON = (
    "Alarming below the threshold: one batch of simulations in a hundred falls there."
)


@dataclass(frozen=True, kw_only=True)
class MMDTest:
    """The outcome of a test.

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

    Args:
        batch: Embeddings, shape ``(n_o, l)``. At most 200 random rows are used.
        simulated: Embeddings of simulations, shape ``(n_s, l)``.
        null: The embeddings that the batch would have under the null hypothesis, one
            for each row of ``simulated``, shape ``(n_s, l)``.
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
    findings = [_before(first, tuned=after is not None)]
    if after is not None:
        second = mmd_test(after, simulated, null=simulations.averaged)
        findings.append(_after(first, second))
    return findings


def _before(test: MMDTest, *, tuned: bool) -> Finding:
    alarming = test.p_value < LEVEL
    if alarming:
        sentence = (
            "As NPE sees it, the batch is unlike simulations: its squared MMD is "
            f"{_ratio(test)} that of a batch of simulations. The simulator is "
            "misspecified, or the batch has other parameters than the prior; this "
            "test cannot tell which."
        )
        if tuned:
            sentence += " The calibration pairs are there to repair this."
    else:
        sentence = (
            "No sign that NPE sees the batch as unlike simulations: "
            f"{test.p_value:.0%} of batches of simulations differ from others as much."
        )
    return Finding(
        name="misspecification before tuning",
        value=test.p_value,
        threshold=LEVEL,
        alarming=alarming,
        is_p_value=True,
        is_expected=alarming and tuned,
        concerns="NPE",
        sentence=sentence,
        reason=REASON,
    )


def _after(before: MMDTest, after: MMDTest) -> Finding:
    alarming = after.p_value < LEVEL
    course = f"{before.mmd:.2g} before tuning, {after.mmd:.2g} after"
    if alarming:
        sentence = (
            "After tuning the batch is unlike simulations: its squared MMD is "
            f"{_ratio(after)} what is usual ({course}). If the batch is shifted or "
            "narrower than the prior, this may be the reason. "
            "Otherwise there may be too few calibration pairs, or they are unlike the "
            "batch."
        )
    else:
        sentence = (
            "No sign that the batch is less like simulations after tuning than "
            "averaging over the simulator's noise explains: "
            f"{after.p_value:.0%} of batches of simulations differ as much (squared "
            f"MMD {course})."
        )
    return Finding(
        name="misspecification after tuning",
        value=after.p_value,
        threshold=LEVEL,
        alarming=alarming,
        is_p_value=True,
        concerns="RoPE",
        sentence=sentence,
        reason=REASON,
    )


def _ratio(test: MMDTest) -> str:
    ratio = test.mmd / max(test.usual, 1e-300)
    return f"{ratio:.0f} times" if ratio >= 10 else f"{ratio:.1f} times"
