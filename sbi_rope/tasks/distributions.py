r"""Distributions that priors need and torch does not have."""

import math
from typing import TYPE_CHECKING, Any

import torch
from sbi.utils import BoxUniform
from torch import Size, Tensor
from torch.distributions import Distribution, constraints

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Arcsine", "UniformDistance", "box"]

# Nearest relative distance to its ends at which an arcsine density is evaluated.
ARCSINE_EDGE = 2.0**-23


def box(
    low: tuple[float, ...], high: tuple[float, ...], *, closed: bool = False
) -> BoxUniform:
    """Return a uniform law on a box, float32 whatever torch's default is.

    Args:
        low: Smallest value of each parameter.
        high: Largest value of each parameter.
        closed: Whether ``high`` itself has a density. torch's uniform laws exclude
            their upper end, where recorded parameters do lie.

    Example:
        >>> ends = torch.tensor([[0.0], [2.0]])
        >>> box((0.0,), (2.0,)).log_prob(ends).exp()
        tensor([0.5000, 0.0000])
        >>> box((0.0,), (2.0,), closed=True).log_prob(ends).exp()
        tensor([0.5000, 0.5000])
    """
    lower, upper = (torch.tensor(ends, dtype=torch.float32) for ends in (low, high))
    if closed:
        upper = upper.nextafter(torch.full_like(upper, torch.inf))
    return BoxUniform(lower, upper)


class _FromZero(Distribution):
    """A law on the interval from 0 to ``width`` that is drawn by inversion."""

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

    def rsample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw by inversion, differentiable with respect to ``width``."""
        shape = self._extended_shape(sample_shape)
        uniform = torch.rand(shape, dtype=self.width.dtype, device=self.width.device)
        return self.icdf(uniform)

    def expand(self, batch_shape: Any, _instance: Distribution | None = None) -> "Self":
        """Return this distribution with a larger batch shape."""
        return type(self)(
            self.width.expand(batch_shape), validate_args=self._validate_args
        )


class Arcsine(_FromZero):
    r"""Squared cosine of a uniform angle: what two polarisers let through.

    With :math:`\varphi \sim \mathcal{U}(0, 2 \pi)`, the density of
    :math:`\alpha = w \cos^2 \varphi` is

    .. math:: p(\alpha) = \frac{1}{\pi \sqrt{\alpha (w - \alpha)}},
        \qquad 0 \le \alpha \le w;

    :math:`\alpha / w` is a Beta(1/2, 1/2) variable. The density is infinite at both
    ends, which parallel and crossed polarisers reach. So that scores stay finite, it
    is evaluated no nearer to them than :math:`2^{-23} w \approx 10^{-7} w`, the
    resolution of float32 below 1; the mass so lost at each end is
    :math:`10^{-4}`.

    Args:
        width: The length :math:`w` of the support; its shape is the batch shape.
        validate_args: As in torch.

    References:
        https://en.wikipedia.org/wiki/Arcsine_distribution

    Example:
        >>> malus = Arcsine(torch.tensor([1.0]))
        >>> malus.variance
        tensor([0.1250])
        >>> malus.log_prob(torch.tensor([0.0, 0.5, 1.0]))
        tensor([ 6.8265, -0.4516,  6.8265])
    """

    @property
    def mean(self) -> Tensor:
        r"""The mean, :math:`w / 2`."""
        return self.width / 2

    @property
    def variance(self) -> Tensor:
        r"""The variance, :math:`w^2 / 8`."""
        return self.width**2 / 8

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, finite at the ends and minus infinity outside."""
        if self._validate_args:
            self._validate_sample(value)
        outside = (value < 0) | (value > self.width)
        share = (value / self.width).clamp(ARCSINE_EDGE, 1 - ARCSINE_EDGE)
        log_density = -0.5 * (share.log() + (-share).log1p()) - self.width.log()
        return torch.where(outside, -torch.inf, log_density - math.log(math.pi))

    def cdf(self, value: Tensor) -> Tensor:
        r"""Distribution function, :math:`\frac{2}{\pi} \arcsin \sqrt{\alpha / w}`."""
        if self._validate_args:
            self._validate_sample(value)
        return 2 / math.pi * (value / self.width).clamp(0.0, 1.0).sqrt().asin()

    def icdf(self, value: Tensor) -> Tensor:
        r"""Quantile function, :math:`w \sin^2 (\pi u / 2)`."""
        return self.width * (math.pi / 2 * value).sin() ** 2


class UniformDistance(_FromZero):
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

    @property
    def mean(self) -> Tensor:
        r"""The mean, :math:`w / 3`."""
        return self.width / 3

    @property
    def variance(self) -> Tensor:
        r"""The variance, :math:`w^2 / 18`."""
        return self.width**2 / 18

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, minus infinity outside of the support."""
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
