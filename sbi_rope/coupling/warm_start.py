"""Where to start the next solution of a sweep."""

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

    In units of the cost, :math:`\gamma w` changes slowly with gamma. It is continued
    linearly from the two last, larger gammas at the same tau.

    Args:
        solved: Potentials by (gamma, tau), all at this gamma or larger ones.
        gamma: As in the keys of ``solved``.
        tau: As in the keys of ``solved``.
        cold: The potential to start from if nothing is solved yet.
    """
    # At the first gamma there is only another tau to start from.
    keys = sorted(key for key in solved if key[1] == tau) or sorted(solved)[:1]
    if not keys:
        return cold
    scaled = [key[0] * solved[key] for key in keys[:2]]
    if len(scaled) == 1:
        return scaled[0] / gamma
    (last, _), (before, _) = keys[:2]
    step = (gamma - last) / (last - before)
    return (scaled[0] + step * (scaled[0] - scaled[1])) / gamma
