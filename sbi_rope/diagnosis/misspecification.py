"""Test whether a batch is like simulations and pairs, and has simulations near it."""

from collections.abc import Sequence

import torch
from scipy.stats import binom
from torch import Tensor, nn

from sbi_rope.diagnosis.report import Finding
from sbi_rope.metrics.statistics import LEVEL, TwoSampleTest
from sbi_rope.npe.standardisation import FAR, deviations

# The most observations and simulations in one MMD, whose cost is quadratic.
MAX_OBSERVATIONS, MAX_SIMULATIONS = 200, 400
NUM_DRAWS = 200
CHUNK = 500  # rows of distances that are computed at a time
# An observation is flagged if its nearest simulation is farther away than the nearest
# neighbours of all simulations but this share.
FLAGGED_SHARE = 0.001
# Among many observations some are flagged by chance, but hardly one is this many times
# as far away as the limit.
FAR_AWAY = 2.0


def mmd_test(batch: Tensor, simulated: Tensor, null: Tensor) -> tuple[float, float]:
    """Return the squared MMD of a batch in units of its usual value, and a p-value.

    At most 200 random rows of the batch ``(n_o, l)`` are used. Under the null
    hypothesis, it has embeddings as in ``null``, one for each simulation ``(n_s, l)``.
    sbi's own p-value compares an MMD of n against m points with MMDs of n against
    m - n points, which are larger on average. Here the numbers of points are the same.

    References:
        | Detecting Model Misspecification in Amortized Bayesian Inference with Neural
          Networks (Schmitt et al., 2023)
        | https://arxiv.org/abs/2112.08866
    """
    num_real = min(len(batch), MAX_OBSERVATIONS, len(simulated) // 3)
    num_simulated = min(MAX_SIMULATIONS, len(simulated) - num_real)
    chosen = batch[torch.randperm(len(batch))[:num_real]]
    usual = torch.empty(NUM_DRAWS, dtype=torch.float64)
    for i in range(NUM_DRAWS):
        order = torch.randperm(len(simulated))[: num_real + num_simulated]
        real, other = order[:num_real], order[num_real:]
        usual[i] = _squared_mmd(null[real], simulated[other])
    other = torch.randperm(len(simulated))[:num_simulated]
    value = _squared_mmd(chosen, simulated[other])
    # The batch itself counts as one of the draws, so that p is never 0.
    p_value = (1 + int((usual >= value).sum())) / (1 + NUM_DRAWS)
    return value / max(float(usual.median()), 1e-300), p_value


def _squared_mmd(a: Tensor, b: Tensor) -> float:
    """Return the squared MMD of two sets, Gaussian, of the median width."""
    scale = 2 * torch.cdist(a, b).median().square()
    pairs = (torch.cdist(*both).square() for both in ((a, a), (b, b), (a, b)))
    within_a, within_b, across = (torch.exp(-far / scale).mean() for far in pairs)
    return float(within_a + within_b - 2 * across)


def before_tuning(test: tuple[float, float], *, tuned: bool) -> Finding:
    """Say whether h(x_o) is unlike h(x_s), which pairs can repair."""
    advice = "This is what the calibration pairs repair, and no alarm."
    if not tuned:
        advice = (
            "Either the simulator is wrong or the batch has other parameters than the "
            "prior. Append calibration pairs, which repair the first."
        )
    return _unlike("before", "NPE", test, advice, is_alarm=not tuned)


def after_tuning(test: tuple[float, float]) -> Finding:
    """Say whether tuning has moved the batch among the simulations."""
    advice = (
        "Append more calibration pairs like the batch, or lower tau if the batch is "
        "narrower than the prior or shifted."
    )
    return _unlike("after", "RoPE's tuned embedding net", test, advice)


def _unlike(
    when: str,
    net: str,
    test: tuple[float, float],
    advice: str,
    *,
    is_alarm: bool = True,
) -> Finding:
    ratio, p_value = test
    text = (
        f"{net} sees the batch as unlike simulations: its squared MMD is "
        f"{ratio:.{0 if ratio >= 10 else 1}f} times that of a batch of simulations "
        f"(p = {p_value:.2g}). {advice}"
    )
    return _by_p_value(
        f"misspecification {when} tuning", p_value, text, is_alarm=is_alarm
    )


def unlike_pairs(test: TwoSampleTest | None, names: Sequence[str]) -> Finding:
    """Say whether what was found on the pairs holds for the batch."""
    name = "batch unlike the calibration pairs"
    if test is None:
        few = "five observations and five pairs with different labels (or groups)"
        return Finding(name, f"Not tested, because this needs {few}.")
    found = ", ".join(test.parameters(names))
    where = f": its parameters differ in {found}" if found else ""
    text = (
        f"NPE sees the batch as unlike the pairs (p = {test.p_value:.2g}){where}. "
        "Label some observations like those of the batch. Weights, scores, calibration "
        "and guarantees that were found on the pairs need not hold here."
    )
    return _by_p_value(name, test.p_value, text)


def _by_p_value(
    name: str, p_value: float, text: str, *, is_alarm: bool = True
) -> Finding:
    is_unlike = p_value < LEVEL
    sentence = text if is_unlike else f"No sign of it (p = {p_value:.2g})."
    return Finding(name, sentence, is_unlike and is_alarm, p_value, LEVEL)


def far_entries(embedding_net: nn.Module, x_o: Tensor) -> Finding:
    """Say how far the farthest entry of x is from simulations."""
    name, far = "entries far from simulations", deviations(embedding_net, x_o)
    if far is None:
        why = 'NPE does not standardise x (`z_score_x="independent"` does)'
        return Finding(name, f"Not tested, because {why}.")
    far = far.flatten(1)
    row, column = divmod(int(far.argmax()), far.shape[1])
    value = float(far.max())
    sentence = (
        f"Entry {column} of observation {row} is the farthest, {value:.2g} standard "
        "deviations of simulations from their mean."
    )
    if value > FAR:
        sentence += " Check its unit: the answer of NPE is arbitrary there."
    return Finding(name, sentence, value > FAR, value, FAR)


def distances(real: Tensor, simulated: Tensor, ends: Sequence[Tensor]) -> Tensor:
    """Return how far ``real`` is from the nearest simulation, where 1 is the limit.

    One or two in a thousand simulations exceed the limit if they take the place of
    observations. A tuned g may put observations between simulations, such as between
    the categories of an entry. The limit is the larger one of the ``ends``, that is, of
    simulations as tuning would move them and unchanged.
    """
    # A new value exceeds the (k+1)-th largest of n with probability (k + 1) / (n + 1).
    k = int(FLAGGED_SHARE * len(simulated))
    limit = max(
        float(_nearest(end, simulated, others=True).sort().values[-1 - k])
        for end in ends
    )
    return _nearest(real, simulated) / max(limit, torch.finfo(torch.float64).tiny)


def _nearest(points: Tensor, among: Tensor, *, others: bool = False) -> Tensor:
    """Return the distance to the nearest, or the nearest in any of the other rows."""
    nearest = []
    for rows in torch.arange(len(points)).split(CHUNK):
        distance = torch.cdist(points[rows], among)
        if others:
            distance.scatter_(1, rows[:, None], torch.inf)
        nearest.append(distance.amin(dim=1))
    return torch.cat(nearest)


def unmatched(distance: Tensor, num_simulations: int) -> Finding:
    """Say how many observations have no simulation near them.

    One batch of simulations in a hundred has more flags than the threshold. A single
    observation that is very far away is an alarm by itself.
    """
    count, flags = len(distance), (distance > 1).nonzero().flatten().tolist()
    chance = (int(FLAGGED_SHARE * num_simulations) + 1) / (num_simulations + 1)
    allowed = float(binom.ppf(0.99, count, chance))
    value, threshold, farthest = float(len(flags)), allowed, float(distance.max())
    sentence = (
        f"{len(flags)} of {count} observations have no simulation near them (by chance "
        f"up to {allowed:.0f}), and observation {int(distance.argmax())} is the "
        f"farthest, at {farthest:.2g} times the limit."
    )
    if value <= threshold and farthest > FAR_AWAY:
        value, threshold = farthest, FAR_AWAY
    if alarming := value > threshold:
        shown = ", ".join(map(str, flags[:10])) + (", ..." if flags[10:] else "")
        sentence += f" Look at {shown} before you trust their posteriors."
    name = "observations no simulation matches"
    return Finding(name, sentence, alarming, value, threshold)
