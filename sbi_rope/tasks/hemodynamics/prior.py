r"""The law of stroke volume and ejection time over the population, as a density."""

from typing import Any

import torch
from torch import Size, Tensor
from torch.distributions import Distribution, biject_to, constraints
from torch.distributions.transforms import IndependentTransform, Transform
from torch.nn.functional import logsigmoid

from sbi_rope.tasks.hemodynamics.prior_table import Band, prior_table

# Nearest relative distance to the edges of the support of draws and of what real
# numbers are mapped to: several units in the last place of a float32, so that rounding
# takes none of them outside.
EDGE = 1e-6


class PopulationPrior(Distribution):
    r"""Distribution of :math:`\theta` = (stroke volume in ml, ejection time in ms).

    It is the marginal law of :class:`Population`, over age :math:`a` and heart rate
    :math:`f`:

    .. math:: p(V, t_e) = \iint p(t_e \mid V, f) \, p(f \mid a) \, p(V \mid a) \, p(a)
        \; \mathrm{d} f \, \mathrm{d} a .

    The support is a parallelogram, bounded in :math:`V` and in :math:`t_e` minus what
    it is expected to be given :math:`V`. On it, the density is calculated once on a
    grid, in closed form over the heart rate and by quadrature over age. In between it
    is bilinear in the coordinates of the parallelogram, and scaled so that its
    integral is one; draws have exactly this density. As the cut laws go to zero at
    some edges, it is zero in slivers there, that have no draws.

    Example:
        >>> prior = PopulationPrior()
        >>> prior.mean
        tensor([ 60.0..., 282.0...])
        >>> prior.log_prob(torch.tensor([[60.0, 280.0], [60.0, 400.0]]))
        tensor([-7.35...,    -inf])
    """

    arg_constraints: dict = {}  # type: ignore[override]  # noqa: RUF012

    def __init__(self) -> None:
        table = prior_table()
        self._band = table.band
        self._density = torch.from_numpy(table.density.copy())
        self._marginal_grid = torch.from_numpy(table.marginal_grid.copy())
        self._marginal_cdf = torch.from_numpy(table.marginal_cdf.copy())
        self._moments = torch.tensor(
            [table.mean, table.variance], dtype=torch.float32, device="cpu"
        )
        super().__init__(event_shape=Size((2,)), validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """The closed parallelogram."""
        return _InBand(self._band)

    @property
    def mean(self) -> Tensor:
        """The means in ml and ms, shape ``(2,)``."""
        return self._moments[0]

    @property
    def variance(self) -> Tensor:
        """The variances in ml^2 and ms^2, shape ``(2,)``."""
        return self._moments[1]

    def sample(self, sample_shape: Any = Size()) -> Tensor:  # noqa: B008
        """Draw a cell of the grid, and then a place in it by inversion."""
        shape = self._extended_shape(Size(sample_shape))
        with torch.no_grad():
            density = self._density
            uniform = torch.rand(
                (*shape[:-1], 3), dtype=density.dtype, device=density.device
            )
            rows, columns = (size - 1 for size in density.shape)
            mass = density.unfold(0, 2, 1).unfold(1, 2, 1).sum(dim=(2, 3)).flatten()
            steps = mass.cumsum(0)
            cell = torch.searchsorted(steps, uniform[..., 0] * steps[-1], right=True)
            cell = cell.clamp(max=rows * columns - 1)
            i, j = cell // columns, cell % columns
            low, high = density[i, j], density[i + 1, j]
            low_next, high_next = density[i, j + 1], density[i + 1, j + 1]
            across = _linear_quantile(uniform[..., 1], low + low_next, high + high_next)
            along = _linear_quantile(
                uniform[..., 2],
                torch.lerp(low, high, across),
                torch.lerp(low_next, high_next, across),
            )
            shares = torch.stack([(i + across) / rows, (j + along) / columns], dim=-1)
            return self._band.theta(shares.clamp(EDGE, 1 - EDGE)).to(torch.float32)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density, minus infinity outside of the support."""
        shares = self._band.shares(value)
        inside = ((shares >= 0) & (shares <= 1)).all(dim=-1)
        shares = shares.clamp(0.0, 1.0)
        rows, columns = (size - 1 for size in self._density.shape)
        u, v = shares[..., 0] * rows, shares[..., 1] * columns
        i = u.detach().long().clamp(max=rows - 1)
        j = v.detach().long().clamp(max=columns - 1)
        near = torch.lerp(self._density[i, j], self._density[i + 1, j], u - i)
        far = torch.lerp(self._density[i, j + 1], self._density[i + 1, j + 1], u - i)
        density = torch.lerp(near, far, v - j) / self._band.area
        # Clamped, so that gradients are zero and not NaN where there is no density.
        tiny = torch.finfo(density.dtype).tiny
        log_density = density.clamp(min=tiny).log()
        log_density = log_density.where(inside & (density > 0), -torch.inf)
        return log_density.to(value.dtype)

    def marginal_cdf(self, theta: Tensor) -> Tensor:
        """Return each parameter's own distribution function.

        Args:
            theta: Stroke volumes in ml and ejection times in ms, shape ``(n, 2)``.

        Returns:
            Probabilities of a smaller value, shape ``(n, 2)``; uniform for draws.
        """
        low, high = self._marginal_grid[:, :1], self._marginal_grid[:, -1:]
        steps = self._marginal_grid.shape[1] - 1
        place = (theta.T.to(low) - low) / (high - low) * steps
        place = place.clamp(0.0, steps)
        i = place.long().clamp(max=steps - 1)
        cdf = self._marginal_cdf
        return torch.lerp(cdf.gather(1, i), cdf.gather(1, i + 1), place - i).T.to(theta)

    def to(self, device: str | torch.device) -> None:
        """Move to a device in place, as sbi expects of a prior."""
        for name in ("_density", "_marginal_grid", "_marginal_cdf", "_moments"):
            setattr(self, name, getattr(self, name).to(device))


def _linear_quantile(uniform: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Return quantiles of the density on [0, 1] that is linear between two values."""
    tiny = torch.finfo(uniform.dtype).tiny  # for 0 / 0 where both start at zero
    root = (start**2 + uniform * (end**2 - start**2)).sqrt()
    return uniform * (start + end) / (start + root).clamp(min=tiny)


class _InBand(constraints.Constraint):
    event_dim = 1

    def __init__(self, band: Band) -> None:
        self.band = band

    def check(self, value: Tensor) -> Tensor:
        shares = self.band.shares(value)
        return ((shares >= 0) & (shares <= 1)).all(dim=-1)


class _BandTransform(Transform):
    """Map two real numbers to relative positions in the parallelogram."""

    domain = constraints.real_vector
    bijective = True

    def __init__(self, band: Band) -> None:
        self.band = band
        self.codomain = _InBand(band)
        super().__init__()

    def _call(self, x: Tensor) -> Tensor:
        shares = x.double().sigmoid().clamp(EDGE, 1 - EDGE)
        return self.band.theta(shares).to(x.dtype)

    def _inverse(self, y: Tensor) -> Tensor:
        shares = self.band.shares(y).clamp(EDGE, 1 - EDGE)  # finite on the edges
        return shares.logit().to(y.dtype)

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        return (logsigmoid(x) + logsigmoid(-x) + self.band.log_widths(x)).sum(dim=-1)


@biject_to.register(_InBand)
def _biject_to_band(constraint: _InBand) -> Transform:
    # sbi wraps whatever is not an `IndependentTransform`, and would then sum the log
    # determinants of a batch.
    return IndependentTransform(_BandTransform(constraint.band), 0)
