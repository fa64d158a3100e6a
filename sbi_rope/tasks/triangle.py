"""The uniform law on a triangle, which sbi can transform to the plane."""

from typing import Any

import torch
from torch import Size, Tensor
from torch.distributions import Distribution, biject_to, constraints
from torch.distributions.transforms import IndependentTransform, Transform
from torch.nn.functional import logsigmoid

__all__ = ["UniformTriangle"]


class UniformTriangle(Distribution):
    r"""Uniform distribution on pairs of numbers, the larger one first.

    .. math:: p(a, b) = \frac{2}{h^2}, \qquad 0 \le b \le a \le h.

    Args:
        high: The largest value :math:`h` of both entries; its shape is the batch
            shape, and a single triangle has a scalar.
        validate_args: As in torch.

    Example:
        >>> triangle = UniformTriangle(torch.tensor(0.5))
        >>> triangle.log_prob(torch.tensor([[0.4, 0.1], [0.3, 0.2]])).exp()
        tensor([8., 8.])
        >>> triangle.mean
        tensor([0.3333, 0.1667])
    """

    has_rsample = True

    def __init__(self, high: Tensor, validate_args: bool | None = None) -> None:  # noqa: FBT001
        self.high = high
        super().__init__(
            batch_shape=high.shape, event_shape=Size((2,)), validate_args=validate_args
        )

    @property
    def arg_constraints(self) -> dict[str, constraints.Constraint]:
        """The largest value is positive."""
        return {"high": constraints.positive}

    @property
    def support(self) -> constraints.Constraint:
        """The closed triangle."""
        return _Triangle(self.high)

    @property
    def mean(self) -> Tensor:
        r"""The means :math:`2h / 3` and :math:`h / 3`, shape ``(*batch, 2)``."""
        return torch.stack([2 * self.high / 3, self.high / 3], dim=-1)

    @property
    def variance(self) -> Tensor:
        r"""The variances, both :math:`h^2 / 18`, shape ``(*batch, 2)``."""
        return (self.high**2 / 18).unsqueeze(-1).expand(self._extended_shape())

    def rsample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw by inversion, differentiable with respect to ``high``."""
        shape = self._extended_shape(sample_shape)
        uniform = torch.rand(shape, dtype=self.high.dtype, device=self.high.device)
        larger = self.high * uniform[..., 0].sqrt()
        return torch.stack([larger, larger * uniform[..., 1]], dim=-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, minus infinity outside of the support."""
        if self._validate_args:
            self._validate_sample(value)
        inside = self.support.check(value)
        return torch.where(inside, (2 / self.high**2).log(), -torch.inf)

    def expand(
        self, batch_shape: Any, _instance: Distribution | None = None
    ) -> "UniformTriangle":
        """Return this distribution with a larger batch shape."""
        return UniformTriangle(
            self.high.expand(batch_shape), validate_args=self._validate_args
        )

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
