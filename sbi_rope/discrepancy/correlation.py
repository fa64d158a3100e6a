"""Errors of recordings of one person or specimen, which have something in common."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["GroupErrors", "independent_pairs"]


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupErrors:
    r"""Errors of calibration pairs that are correlated within groups.

    The errors E of n pairs have the matrix normal distribution

    .. math::
        E \sim \mathcal{MN}(0, R, \Sigma), \qquad
        R_{ij} = \begin{cases} 1 & \text{if } i = j, \\
        \rho & \text{if } i \neq j \text{ are of the same group}, \\
        0 & \text{otherwise}, \end{cases}

    so that the rows of :math:`R^{-1/2} E` are independent.

    Attributes:
        groups: Numbers of the groups from 0 on, shape ``(n,)``.
        correlation: :math:`\rho`, at least 0 and less than 1.

    Example:
        >>> errors = GroupErrors(groups=torch.tensor([0, 0, 1]), correlation=0.5)
        >>> root = errors.independent(torch.eye(3))
        >>> torch.linalg.inv(root.T @ root)
        tensor([[1.0000, 0.5000, 0.0000],
                [0.5000, 1.0000, 0.0000],
                [0.0000, 0.0000, 1.0000]])
        >>> round(math.exp(errors.log_det), 6), round(errors.trace_of_inverse, 6)
        (0.75, 3.666667)
    """

    groups: Tensor
    correlation: float

    def independent(self, values: Tensor) -> Tensor:
        """Return :math:`R^{-1/2}` times values of the pairs, ``(*batch, n, k)``."""
        *batch, _, width = values.shape
        sizes = self.groups.bincount().to(values)[:, None]
        sums = values.new_zeros(*batch, len(sizes), width)
        sums = sums.index_add(-2, self.groups, values)
        mean = (sums / sizes)[..., self.groups, :]
        # The eigenvalues of R, of means of groups and of differences within groups.
        of_means = (1 + (sizes - 1) * self.correlation)[self.groups]
        return mean / of_means.sqrt() + (values - mean) / (1 - self.correlation) ** 0.5

    @property
    def log_det(self) -> float:
        r""":math:`\log \det R`."""
        sizes = self.groups.bincount().double()
        within = (sizes - 1) * math.log1p(-self.correlation)
        return float((within + ((sizes - 1) * self.correlation).log1p()).sum())

    @property
    def trace_of_inverse(self) -> float:
        r""":math:`\operatorname{tr} R^{-1}`."""
        sizes = self.groups.bincount().double()
        within = (sizes - 1) / (1 - self.correlation)
        return float((within + 1 / (1 + (sizes - 1) * self.correlation)).sum())


def independent_pairs(
    groups: Tensor, correlation: float | Tensor, weights: Tensor | None = None
) -> Tensor:
    r"""Return how many independent pairs each pair counts as, ``(*batch, n)``.

    A pair among k of its group counts as :math:`1 / (1 + (k - 1) \rho)`. If the weights
    of a group differ, k is its effective number of pairs: the squared sum of its
    weights over the sum of their squares.

    Args:
        groups: Numbers of the groups from 0 on, shape ``(n,)``.
        correlation: :math:`\rho`, a number or of shape ``batch``.
        weights: What each pair would count as by itself, shape ``(n,)``; one if None.

    References:
        | Survey Sampling (Kish, 1965), of the design effect

    Example:
        >>> independent_pairs(torch.tensor([0, 0, 0, 1]), 0.5)
        tensor([0.5000, 0.5000, 0.5000, 1.0000], dtype=torch.float64)
    """
    w = torch.ones_like(groups).double() if weights is None else weights.double()
    number = groups.bincount(weights=w).square() / groups.bincount(weights=w.square())
    correlation = torch.as_tensor(correlation).to(w)[..., None]
    return w / (1 + (number[groups] - 1) * correlation)
