"""Observations and statistics in standard deviations of the simulations."""

import torch
from torch import Tensor, nn

from sbi_rope._sbi import standardisation_of
from sbi_rope.errors import warn_user

__all__ = [
    "FAR",
    "ROUNDING",
    "Standardisation",
    "deviations",
    "leave_out_constants",
    "warn_of_far_entries",
    "warn_of_unseen_gaps",
]

# An entry is far if it is more than so many standard deviations away from simulations.
# No measurement of the tasks is half as far away. A column that is constant in
# simulations but varies by 0.01 in reality is 100,000 away.
FAR = 30.0
# A standard deviation smaller than this share of the mean is taken for rounding error.
ROUNDING = 1e-6


def deviations(embedding_net: nn.Module, x: Tensor) -> Tensor | None:
    r"""Return how far each entry of x is from the mean of the simulations.

    .. math:: |x - \bar x_s| / \operatorname{sd}(x_s)

    Args:
        embedding_net: The embedding net of a trained estimator, which starts with sbi's
            standardising layer.
        x: Observations, shape ``(n, *event_shape)``.

    Returns:
        The distances in standard deviations of the simulations, shape
        ``(n, *event_shape)``, or None if NPE does not standardise x. Missing entries
        (NaN) have a distance of zero.
    """
    mean_and_std = standardisation_of(embedding_net)
    if mean_and_std is None:
        return None
    mean, std = mean_and_std
    return ((x - mean) / std).abs().nan_to_num(nan=0.0, posinf=torch.inf)


@torch.no_grad()
def leave_out_constants(embedding_net: nn.Module, x: Tensor) -> None:
    """Make a net ignore the entries that are the same in all calibration pairs.

    sbi divides an entry that does not vary by 1e-7. In an observation where it does
    vary, it would then be much larger than all other entries.

    Args:
        embedding_net: A net with sbi's standardising layer, which is changed.
        x: The calibration x that gave the layer its mean and standard deviation, shape
            ``(n, *event_shape)``.
    """
    mean_and_std = standardisation_of(embedding_net)
    if mean_and_std is None or mean_and_std[1].shape != x.shape[1:]:
        return  # x is not standardised, or all entries have one standard deviation
    constant = x.std(dim=0) <= ROUNDING * x.abs().amax(dim=0)
    if not constant.any():
        return
    mean_and_std[1].masked_fill_(constant, torch.inf)
    entries = constant.flatten().nonzero().flatten().tolist()
    warn_user(
        f"{len(entries)} of the {constant.numel()} entries of the calibration `x` are "
        f"the same in all pairs that are trained on (first: {entries[:5]}). They say "
        "nothing about the parameters and are left out."
    )


def warn_of_far_entries(name: str, x: Tensor, embedding_net: nn.Module) -> None:
    """Warn of entries of ``x`` that are far from all simulations NPE was trained on."""
    far = deviations(embedding_net, x)
    if far is None or not (far > FAR).any():
        return
    far = far.flatten(1)
    rows = (far > FAR).any(dim=1).nonzero().flatten()
    columns = (far > FAR).any(dim=0).nonzero().flatten()
    warn_user(
        f"{len(columns)} of the {far.shape[1]} entries of `{name}` (first: "
        f"{columns[:5].tolist()}) are up to {float(far.max()):.1g} standard deviations "
        f"away from simulations, in {len(rows)} of {len(far)} rows (first: "
        f"{rows[:5].tolist()}). NPE was not trained on such numbers, so its posteriors "
        "for these rows cannot be trusted. Check the units. Leave out entries that do "
        "not vary in simulations, or train NPE with z_score_x='structured', which uses "
        "one standard deviation for all entries."
    )


def warn_of_unseen_gaps(name: str, x: Tensor, seen: Tensor) -> None:
    """Warn of entries that are missing (NaN) in reality, but in no simulation.

    Entries of vectors are compared one by one. Which trials of a set are missing, or
    which pixels of an image, does not matter.

    Args:
        name: What the user calls ``x``.
        x: Real observations, shape ``(n, *event_shape)``.
        seen: Which entries are missing in some simulation, shape ``(*event_shape)``.
    """
    if x.ndim > 2:
        seen = seen.any()
    unseen = x.isnan() & ~seen
    if not unseen.any():
        return
    entries = unseen.any(dim=0)
    rows = unseen.flatten(1).any(dim=1).nonzero().flatten()
    which = f", in {len(rows)} of {len(x)} rows (first: {rows[:5].tolist()})"
    if x.ndim == 2:
        which = f" (first: {entries.nonzero().flatten()[:5].tolist()}){which}"
    warn_user(
        f"{int(entries.sum())} of the {entries.numel()} entries of `{name}` are "
        f"missing (NaN){which}, but in no simulation. The embedding net of NPE has not "
        "learned what to do without them. Train NPE on simulations whose entries are "
        "missing as in reality, or leave these rows out."
    )


class Standardisation(nn.Module):
    """Divide statistics by their standard deviation over simulations, and undo it.

    Statistics that are the same in all simulations have no such unit. They are left out
    of the standardised statistics, and get their simulated value back from
    :meth:`undo`.

    Args:
        simulated: Statistics of simulations, shape ``(n, l)``.
    """

    mean: Tensor
    std: Tensor
    varies: Tensor

    def __init__(self, simulated: Tensor) -> None:
        super().__init__()
        std, mean = torch.std_mean(simulated, dim=0)
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        self.register_buffer("varies", std > ROUNDING * mean.abs())

    def forward(self, statistics: Tensor) -> Tensor:
        """Standardise statistics of shape ``(..., l)``; the result is ``(..., l')``."""
        return ((statistics - self.mean) / self.std)[..., self.varies]

    def undo(self, standardised: Tensor) -> Tensor:
        """Return statistics in their own units, ``(..., l')`` to ``(..., l)``."""
        shape = (*standardised.shape[:-1], len(self.mean))
        statistics = self.mean.expand(shape).clone()
        statistics[..., self.varies] += standardised * self.std[self.varies]
        return statistics
