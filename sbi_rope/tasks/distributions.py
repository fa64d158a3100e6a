r"""Distributions that priors need and torch does not have."""

from typing import Any

import torch
from torch import Size, Tensor
from torch.distributions import Distribution, constraints

__all__ = ["UniformDistance"]


class UniformDistance(Distribution):
    r"""Distance between two independent uniform draws.

    With :math:`U, V \sim \mathcal{U}[a, a + w]`, the density of
    :math:`d = |U - V|` is

    .. math:: p(d) = \frac{2 (w - d)}{w^2}, \qquad 0 \le d \le w,

    whatever :math:`a`: it is :math:`w` times a Beta(1, 2) variable.

    Args:
        width: The length :math:`w` of the interval of the uniform draws; its shape is
            the batch shape.
        validate_args: As in torch.

    Example:
        >>> distance = UniformDistance(torch.tensor([40.0]))
        >>> distance.mean
        tensor([13.3333])
        >>> distance.log_prob(torch.tensor([0.0])).exp()
        tensor([0.0500])
    """

    has_rsample = True

    def __init__(self, width: Tensor, validate_args: bool | None = None) -> None:  # noqa: FBT001
        self.width = width
        super().__init__(batch_shape=width.shape, validate_args=validate_args)

    @property
    def arg_constraints(self) -> dict[str, constraints.Constraint]:
        """The width is positive."""
        return {"width": constraints.positive}

    @property
    def support(self) -> constraints.Constraint:
        """The closed interval from 0 to ``width``."""
        return constraints.interval(torch.zeros_like(self.width), self.width)

    @property
    def mean(self) -> Tensor:
        r"""The mean, :math:`w / 3`."""
        return self.width / 3

    @property
    def variance(self) -> Tensor:
        r"""The variance, :math:`w^2 / 18`."""
        return self.width**2 / 18

    def rsample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw by inversion, differentiable with respect to ``width``."""
        shape = self._extended_shape(sample_shape)
        uniform = torch.rand(shape, dtype=self.width.dtype, device=self.width.device)
        return self.icdf(uniform)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density; minus infinity outside of the support."""
        if self._validate_args:
            self._validate_sample(value)
        density = 2 * (self.width - value) / self.width**2
        return torch.where(value < 0, 0.0, density.clamp(min=0.0)).log()

    def cdf(self, value: Tensor) -> Tensor:
        r"""Distribution function, :math:`1 - (1 - d / w)^2`."""
        if self._validate_args:
            self._validate_sample(value)
        return 1 - (1 - value / self.width).clamp(0.0, 1.0) ** 2

    def icdf(self, value: Tensor) -> Tensor:
        r"""Quantile function, :math:`w (1 - \sqrt{1 - u})`."""
        # The same without the difference of two numbers close to one.
        return self.width * value / (1 + (1 - value).sqrt())

    def expand(
        self, batch_shape: Any, _instance: Distribution | None = None
    ) -> "UniformDistance":
        """Return this distribution with a larger batch shape."""
        return UniformDistance(
            self.width.expand(batch_shape), validate_args=self._validate_args
        )
