"""A prior with one set of shapes: its density, its bounds and its units."""

import copy
from functools import cached_property
from typing import Any, ClassVar

import torch
from sbi.utils.user_input_checks_utils import move_distribution_to_device
from torch import Tensor
from torch.distributions import Distribution, constraints

from sbi_rope.utils.errors import InvalidInputError, shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.tensors import rows_with

# Draws from which moments are estimated that a prior does not state, and those that are
# moved apart to see whether it has bounds.
NUM_FOR_MOMENTS, NUM_DRAWS, FAR_APART = 10_000, 256, 5.0


class PriorDistribution(Distribution):
    r"""A copy of a prior over parameters of shape ``(d,)``, in float32.

    Its log density is minus infinity outside the support, and on a bound that just
    inside. Where a density is flat, its gradient is zero.

    Args:
        prior: A torch distribution, or what sbi's ``process_prior`` returns.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}  # type: ignore[override]

    def __init__(self, prior: Any) -> None:
        own = prior._own if isinstance(prior, PriorDistribution) else prior
        self._own = copy.deepcopy(own)
        draws = None
        if hasattr(own, "sample"):
            with seeded(0):
                draws = self._own.sample(torch.Size((1,)))
        if not isinstance(draws, Tensor) or draws.ndim != 2:
            raise InvalidInputError(
                "Expected `prior` to be a torch distribution over vectors; got "
                f"{shown(own)}. Use `sbi.utils.process_prior(prior)[0]`."
            )
        # It takes the place of parameters outside the support.
        self._some = draws
        super().__init__(event_shape=draws.shape[1:], validate_args=False)

    def to(self, device: Any) -> None:
        """Move the prior to a device."""
        self._own = move_distribution_to_device(self._own, device)
        self._some = self._some.to(device)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw parameters, shape ``(*sample_shape, d)``."""
        # sbi's MultipleIndependent takes sample shapes with one dimension only.
        shape = torch.Size(sample_shape)
        theta = self._own.sample(torch.Size((shape.numel(),)))
        return theta.float().reshape(*shape, *self.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density at theta ``(*batch, d)``, shape ``(*batch)``."""
        theta = value if value.is_floating_point() else value.float()
        flat = theta.reshape(-1, *self.event_shape)
        low, high = self.bounds(flat)
        moved = self.off_bounds(flat).to(self._some.dtype)
        inside = ((flat >= low) & (flat <= high)).all(dim=1)
        if (support := self._support) is not None:
            inside = inside & support.check(moved).reshape(len(flat), -1).all(dim=1)
        # Outside, torch's distributions raise an error, or return NaN.
        safe = moved.where(inside[:, None], self._some)
        log_prob = self._own.log_prob(safe).reshape(len(flat), -1).sum(dim=1)
        log_prob = log_prob.to(flat) + 0.0 * flat.where(inside[:, None], 0.0).sum(dim=1)
        usable = inside & torch.isfinite(log_prob)
        return log_prob.where(usable, -torch.inf).reshape(theta.shape[:-1])

    def inside(self, theta: Tensor) -> Tensor:
        """Tell which parameters ``(n, d)`` have a finite log density, ``(n,)``."""
        return torch.isfinite(self.log_prob(theta))

    def moved_inside(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return theta ``(n, d)``, rows outside replaced, and which were inside."""
        inside = self.inside(theta)
        return theta.where(inside[:, None], self._some.to(theta)), inside

    @property
    def support(self) -> Any:
        """The support that the prior states, as sbi expects it."""
        return self._own.support

    @cached_property
    def is_unbounded(self) -> bool:
        """Whether parameters far outside all draws have a density, too."""
        with seeded(0):
            draws = self.sample((NUM_DRAWS,))
        apart = draws + FAR_APART * (draws - draws.mean(dim=0))
        return bool(self.inside(apart).all())

    @property
    def _support(self) -> Any:
        try:
            return self._own.support
        except (NotImplementedError, AttributeError):  # it states none
            return None

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return the ends of the support, like ``like``; infinite where not known."""
        low = _entries(self._support, like, "lower_bound", -torch.inf)
        return low, _entries(self._support, like, "upper_bound", torch.inf)

    def off_bounds(self, theta: Tensor) -> Tensor:
        """Return theta ``(n, d)``, those on a bound moved to the next number inside.

        Many densities are zero or infinite on a bound. Discrete parameters stay.
        """
        low, high = self.bounds(theta)
        inside = theta.clamp(low.nextafter(high), high.nextafter(low))
        is_discrete = _entries(self._support, theta, "is_discrete", 0.0) > 0
        return theta.where(is_discrete, inside)

    @property
    def mean(self) -> Tensor:
        """The mean of each parameter, ``(d,)``; estimated if it is not stated."""
        return self._moment("mean")

    @property
    def variance(self) -> Tensor:
        """The variance of each parameter, ``(d,)``; estimated if it is not stated."""
        return self._moment("variance")

    def _moment(self, name: str) -> Tensor:
        try:
            found = getattr(self._own, name)
        except Exception:  # priors of users and of sbi raise all kinds
            with seeded(0):
                draws = self.sample((NUM_FOR_MOMENTS,))
            found = draws.mean(dim=0) if name == "mean" else draws.var(dim=0)
        found = torch.as_tensor(found).detach().to(self._some.device, torch.float32)
        return found.expand(1, *self.event_shape)[0]

    def log_units(self) -> Tensor:
        r"""Return :math:`\log s_j`, with s the standard deviations, ``(d,)``.

        A log score with theta in standard deviations of the prior is higher by their
        sum. It is NaN where the prior has no finite standard deviation.
        """
        std = self.stddev.double()
        return std.log().where((std > 0) & torch.isfinite(std), torch.nan)


def check_in_support(
    name: str, theta: Tensor, prior: Any, *, rows: Tensor | None = None
) -> None:
    """Raise if a row of ``theta``, or one of those ``rows``, has no prior density."""
    outside = ~PriorDistribution(prior).inside(theta)
    if rows is not None:
        outside &= rows
    if outside.any():
        raise InvalidInputError(
            f"Expected `{name}` inside the support of the prior; got "
            f"{rows_with(outside)} outside. Check the units and the order of the "
            "parameters, and give noisy labels with `theta_std`."
        )


def _entries(support: Any, like: Tensor, name: str, default: float) -> Tensor:
    """Return a property of the support of each parameter, like ``like``."""
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    if isinstance(support, constraints.cat):  # of sbi's MultipleIndependent
        columns = zip(support.cseq, like.split(support.lengths, dim=-1), strict=True)
        return torch.cat([_entries(*one, name, default) for one in columns], dim=-1)
    if support is constraints.boolean:
        support = constraints.integer_interval(0, 1)
    return torch.as_tensor(getattr(support, name, default)).to(like).expand_as(like)
