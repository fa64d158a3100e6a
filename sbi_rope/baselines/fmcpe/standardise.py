"""Rows in units of their spread."""

import torch
from torch import Tensor, nn

from sbi_rope._standardisation import ROUNDING

__all__ = ["Standardise"]


class Standardise(nn.Module):
    """Rows in standard deviations from their mean; ``inverse`` undoes it.

    Args:
        rows: Shape ``(n, m)``. A column that does not vary has a deviation of one.
        shared: Whether all columns share a standard deviation, as those of a series. It
            is that of columns that vary.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, rows: Tensor, *, shared: bool = False) -> None:
        super().__init__()
        std, mean = torch.std_mean(rows, dim=0)
        smallest = ROUNDING * mean.abs().clamp_min(ROUNDING)
        varies = std > smallest
        if shared and varies.any():
            std = std[varies].square().mean().sqrt().expand_as(std).clone()
        else:
            std = std.where(varies, torch.ones_like(std))
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, rows: Tensor) -> Tensor:
        """Return the standardised rows, ``(n, m)``."""
        return (rows - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """Return the rows of standardised ones, ``(n, m)``."""
        return self.mean + self.std * z
