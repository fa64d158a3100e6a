"""Observations and statistics in standard deviations of the simulations."""

import torch
from torch import Tensor, nn

from sbi_rope.npe.sbi import standardisation_of
from sbi_rope.utils.errors import warn_user

# An entry is far if it is more than so many standard deviations away from simulations.
# No measurement of the tasks is half as far away.
FAR = 30.0
# A standard deviation smaller than this share of the mean is taken for rounding error.
ROUNDING = 1e-6


def deviations(embedding_net: nn.Module, x: Tensor) -> Tensor | None:
    r"""Return how far each entry of x is from the mean of the simulations.

    .. math:: |x - \bar x_s| / \operatorname{sd}(x_s)

    It has the shape of x, ``(n, *event)``, and is zero for missing entries (NaN). It is
    None if the net has no standardising layer of sbi, which knows the simulations.
    """
    mean_and_std = standardisation_of(embedding_net)
    if mean_and_std is None:
        return None
    mean, std = mean_and_std
    return ((x - mean) / std).abs().nan_to_num(nan=0.0, posinf=torch.inf)


def warn_of_far_entries(name: str, x: Tensor, embedding_net: nn.Module) -> None:
    """Warn of entries of ``x`` that are far from all simulations NPE was trained on."""
    far = deviations(embedding_net, x)
    if far is None:
        return
    mean, std = standardisation_of(embedding_net) or (x, x)
    ignored = torch.isinf(std) & ((x - mean).abs() > 1e-4 * mean.abs())
    never = "never vary in simulations, or by less than 1e-7, and are ignored"
    away = f"up to {float(far.max()):.1g} standard deviations away from simulations"
    for found, what in ((ignored, never), (far > FAR, f"are {away}. Check the units")):
        if found.any():
            entries = found.any(dim=0).flatten().nonzero().flatten()
            warn_user(
                f"{len(entries)} of the {far[0].numel()} entries of `{name}` (first: "
                f"{entries[:5].tolist()}) {what}."
            )


class Standardisation(nn.Module):
    """Divide statistics by their standard deviation over simulations, and undo it.

    Statistics that are the same in all simulations ``(n, l)`` have no such unit. They
    are left out, and get their simulated value back from :meth:`undo`.
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
