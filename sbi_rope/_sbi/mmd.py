"""sbi's maximum mean discrepancy."""

from torch import Tensor

__all__ = ["squared_mmd"]


def squared_mmd(a: Tensor, b: Tensor) -> float:
    """Return the squared MMD of two sets, ``(n, l)`` and ``(m, l)``.

    The kernel is Gaussian. Its width is the median distance between the sets.
    """
    # It is imported here because it needs packages that nothing else here needs. sbi's
    # `calc_misspecification_mmd` would compute one more MMD, for its p-value.
    from sbi.diagnostics.misspecification import compute_rbf_mmd_median_heuristic

    return float(compute_rbf_mmd_median_heuristic(a, b))
