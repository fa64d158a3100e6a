"""Weighted means over calibration pairs, with their errors and intervals."""

import torch
from scipy.stats import t as student
from torch import Tensor

from sbi_rope.data import Counts

__all__ = [
    "counts_of",
    "interval_of_mean",
    "mean_and_error",
    "mean_of_known",
    "means_of_pairs",
    "standard_error_of_mean",
]


def counts_of(weights: Tensor | None, groups: Tensor | None) -> Counts | None:
    """Return the counts of pairs; None if all are independent and count as one."""
    return None if weights is None else Counts(weights, groups)


def standard_error_of_mean(values: Tensor) -> float:
    """Return the standard error of the mean of a vector.

    It is NaN for a single value, and infinite if a value is infinite.
    """
    if values.numel() < 2:
        return float("nan")
    if torch.isinf(values).any():
        return float("inf")
    return float(values.double().std() / values.numel() ** 0.5)


def mean_and_error(values: Tensor, counts: Counts | None) -> tuple[float, float]:
    """Return a mean over pairs and its standard error.

    Args:
        values: A number for each pair, shape ``(n,)``.
        counts: How many pairs each counts as; None for one each.

    The error is infinite if a value is.
    """
    if counts is None:
        return float(values.mean()), standard_error_of_mean(values)
    values, weights = counts.of_groups(values)
    n = len(values)
    mean = (weights * values).sum() / weights.sum()
    if torch.isinf(values).any():
        return float(mean), float("inf")
    square = (weights * (values - mean)).square().sum() / weights.sum().square()
    return float(mean), float((square * n / max(1, n - 1)).sqrt())


def interval_of_mean(
    values: Tensor, counts: Counts | None
) -> tuple[float, float, float]:
    """Return a mean over pairs and the ends of its 95 % interval of Student's t.

    Example:
        >>> import torch
        >>> mean, low, high = interval_of_mean(torch.tensor([1.0, 2.0, 3.0]), None)
        >>> print(f"{mean:.2f}, from {low:.2f} to {high:.2f}")
        2.00, from -0.48 to 4.48
    """
    mean, error = mean_and_error(values, counts)
    n = float(len(values))
    if counts is not None:
        # A few that count as much as all others tell as little as so few alone. Their
        # variance is estimated by these few, too.
        count, n = len(counts.of_groups(values)[0]), max(2.0, counts.effective_number)
        error *= (n / (n - 1) * max(1, count - 1) / count) ** 0.5
    half = float(student.ppf(0.975, max(1.0, n - 1))) * error
    return mean, mean - half, mean + half


def means_of_pairs(values: Tensor, counts: Counts | None) -> Tensor:
    """Return the mean over pairs of those that are not NaN, ``(n, d)`` to ``(d,)``."""
    if counts is None:
        return mean_of_known(values, dim=0)
    weights = counts.weights.to(values)[:, None] * ~torch.isnan(values)
    return (weights * values.nan_to_num()).sum(dim=0) / weights.sum(dim=0)


def mean_of_known(values: Tensor, dim: int) -> Tensor:
    """Return the mean of those that are not NaN; NaN if there are none."""
    return values.nanmean(dim=dim) if values.isnan().any() else values.mean(dim=dim)
