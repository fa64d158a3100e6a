"""Weighted means, with their errors and intervals."""

from scipy.stats import t as student
from torch import Tensor

__all__ = ["interval_of_mean", "mean_and_error"]


def mean_and_error(values: Tensor, weights: Tensor | None) -> tuple[float, float]:
    """Return a mean over pairs and its standard error.

    Args:
        values: A number for each pair, shape ``(n,)``.
        weights: How many pairs each pair counts as, shape ``(n,)``; None for one each.
    """
    n = len(values)
    if weights is None:
        return float(values.mean()), float(values.std() / n**0.5)
    weights = weights.to(values)
    mean = (weights * values).sum() / weights.sum()
    square = (weights * (values - mean)).square().sum() / weights.sum().square()
    return float(mean), float((square * n / max(1, n - 1)).sqrt())


def interval_of_mean(
    values: Tensor, weights: Tensor | None
) -> tuple[float, float, float]:
    """Return a mean over pairs and the ends of its 95 % interval of Student's t.

    Example:
        >>> import torch
        >>> mean, low, high = interval_of_mean(torch.tensor([1.0, 2.0, 3.0]), None)
        >>> print(f"{mean:.2f}, from {low:.2f} to {high:.2f}")
        2.00, from -0.48 to 4.48
    """
    mean, error = mean_and_error(values, weights)
    half = float(student.ppf(0.975, max(1, len(values) - 1))) * error
    return mean, mean - half, mean + half
