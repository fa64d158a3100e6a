r"""Distributions that priors need and torch does not have."""

import math
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Size, Tensor
from torch.distributions import Distribution, biject_to, constraints
from torch.distributions.transforms import IndependentTransform, Transform
from torch.nn.functional import logsigmoid

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

    arg_constraints: dict = {}  # type: ignore[override]  # noqa: RUF012

    def __init__(self, width: Tensor) -> None:
        self.width = width
        super().__init__(batch_shape=width.shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """The closed interval from 0 to ``width``."""
        return constraints.interval(torch.zeros_like(self.width), self.width)

    def sample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw by inversion."""
        shape = self._extended_shape(sample_shape)
        uniform = torch.rand(shape, dtype=self.width.dtype, device=self.width.device)
        return self.icdf(uniform)


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
        outside = (value < 0) | (value > self.width)
        share = (value / self.width).clamp(ARCSINE_EDGE, 1 - ARCSINE_EDGE)
        log_density = -0.5 * (share.log() + (-share).log1p()) - self.width.log()
        return torch.where(outside, -torch.inf, log_density - math.log(math.pi))

    def cdf(self, value: Tensor) -> Tensor:
        r"""Distribution function, :math:`\frac{2}{\pi} \arcsin \sqrt{\alpha / w}`."""
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
        density = 2 * (self.width - value) / self.width**2
        return torch.where(value < 0, 0.0, density.clamp(min=0.0)).log()

    def cdf(self, value: Tensor) -> Tensor:
        r"""Distribution function, :math:`1 - (1 - d / w)^2`."""
        return 1 - (1 - value / self.width).clamp(0.0, 1.0) ** 2

    def icdf(self, value: Tensor) -> Tensor:
        r"""Quantile function, :math:`w (1 - \sqrt{1 - u})`."""
        # The same without the difference of two numbers close to one.
        return self.width * value / (1 + (1 - value).sqrt())


class UniformTriangle(Distribution):
    r"""Uniform distribution on pairs of numbers, the larger one first.

    .. math:: p(a, b) = \frac{2}{h^2}, \qquad 0 \le b \le a \le h.

    Args:
        high: The largest value :math:`h` of both entries, a scalar.

    Example:
        >>> triangle = UniformTriangle(torch.tensor(0.5))
        >>> triangle.log_prob(torch.tensor([[0.4, 0.1], [0.3, 0.2]])).exp()
        tensor([8., 8.])
        >>> triangle.mean
        tensor([0.3333, 0.1667])
    """

    arg_constraints: dict = {}  # type: ignore[override]  # noqa: RUF012

    def __init__(self, high: Tensor) -> None:
        self.high = high
        super().__init__(event_shape=Size((2,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """The closed triangle."""
        return _Triangle(self.high)

    @property
    def mean(self) -> Tensor:
        r"""The means :math:`2h / 3` and :math:`h / 3`, shape ``(2,)``."""
        return torch.stack([2 * self.high / 3, self.high / 3], dim=-1)

    @property
    def variance(self) -> Tensor:
        r"""The variances, both :math:`h^2 / 18`, shape ``(2,)``."""
        return (self.high**2 / 18).expand(2)

    def sample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw by inversion."""
        shape = self._extended_shape(sample_shape)
        uniform = torch.rand(shape, dtype=self.high.dtype, device=self.high.device)
        larger = self.high * uniform[..., 0].sqrt()
        return torch.stack([larger, larger * uniform[..., 1]], dim=-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, minus infinity outside of the support."""
        inside = self.support.check(value)
        return torch.where(inside, (2 / self.high**2).log(), -torch.inf)

    def to(self, device: str | torch.device) -> None:
        """Move to a device in place, as sbi expects of a prior."""
        self.high = self.high.to(device)


class _Triangle(constraints.Constraint):
    event_dim = 1

    def __init__(self, high: Tensor) -> None:
        self.high = high

    def check(self, value: Tensor) -> Tensor:
        larger, smaller = value[..., 0], value[..., 1]
        return (smaller >= 0) & (smaller <= larger) & (larger <= self.high)


class _TriangleTransform(Transform):
    """Map two real numbers to the larger entry over ``high`` and the ratio of both."""

    domain = constraints.real_vector
    bijective = True

    def __init__(self, high: Tensor) -> None:
        self.high = high
        self.codomain = _Triangle(high)
        super().__init__()

    def _call(self, x: Tensor) -> Tensor:
        larger = self.high * x[..., 0].sigmoid()
        return torch.stack([larger, larger * x[..., 1].sigmoid()], dim=-1)

    def _inverse(self, y: Tensor) -> Tensor:
        info = torch.finfo(y.dtype)
        larger = y[..., 0].clamp(min=info.tiny)
        fractions = torch.stack([larger / self.high, y[..., 1] / larger], dim=-1)
        # Finite on the edges as well.
        fractions = fractions.clamp(min=info.tiny, max=1 - info.eps)
        return fractions.log() - (-fractions).log1p()

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        slopes = (logsigmoid(x) + logsigmoid(-x)).sum(dim=-1)
        # The second entry is a fraction of the first, high * sigmoid.
        return slopes + 2 * self.high.log() + logsigmoid(x[..., 0])


@biject_to.register(_Triangle)
def _biject_to_triangle(constraint: _Triangle) -> Transform:
    # sbi wraps whatever is not an `IndependentTransform`, and would then sum the log
    # determinants of a batch.
    return IndependentTransform(_TriangleTransform(constraint.high), 0)
