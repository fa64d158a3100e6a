"""Where the next solution of a sweep starts."""

from collections.abc import Mapping

from torch import Tensor

__all__ = ["warm_start"]


def warm_start(
    solved: Mapping[tuple[float, float], Tensor],
    gamma: float,
    tau: float,
    cold: Tensor,
) -> Tensor:
    r"""Return a potential near the solution at gamma and tau.

    In units of the cost, :math:`\gamma w` changes slowly with gamma. It is extrapolated
    linearly from the two next larger gammas at the same tau.

    Args:
        solved: Potentials by (gamma, tau), all at this gamma or larger ones.
        gamma: The gamma to solve for, in the units of the keys.
        tau: The tau to solve for.
        cold: The potential to start from if nothing is solved yet.
    """
    # At the largest gamma, another tau is all there is to start from.
    keys = sorted(key for key in solved if key[1] == tau) or sorted(solved)[:1]
    if not keys:
        return cold
    scaled = [key[0] * solved[key] for key in keys[:2]]
    if len(scaled) == 1:
        return scaled[0] / gamma
    (last, _), (before, _) = keys[:2]
    step = (gamma - last) / (last - before)
    return (scaled[0] + step * (scaled[0] - scaled[1])) / gamma
