"""The prior: a density that does not depend on x, and its form as an sbi posterior."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._bounds import moved_inside, off_bounds
from sbi_rope._random import seeded
from sbi_rope._sbi import describe, move_distribution_to_device
from sbi_rope.density.base import Accept, Density, Mass
from sbi_rope.density.posterior import MixturePosterior
from sbi_rope.errors import InvalidInputError
from sbi_rope.tensors import as_numbers

__all__ = ["Prior", "PriorPosterior", "prior_log_prob", "prior_sample"]


class Prior(Density):
    r"""The prior :math:`p(\theta)`, whatever x is.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``; it is copied.
        condition_shape: Shape of one observation.
    """

    placeholder: Tensor

    def __init__(self, prior: Distribution, condition_shape: Sequence[int]) -> None:
        super().__init__(prior.event_shape, condition_shape)
        self.prior = copy.deepcopy(prior)
        with seeded(0):
            like = prior.sample(torch.Size((1,)))
        # A distribution has no device. This tensor is on the device of its draws.
        self.register_buffer("placeholder", torch.empty(0, device=like.device))

    def embed(self, x: Tensor) -> Tensor:
        """Return an empty embedding for each observation, ``(n, 0)``."""
        return x.new_empty(len(x), 0)

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        return prior_log_prob(self.prior, theta).double()

    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        return prior_sample(self.prior, torch.Size((len(row),))).to(z)

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations have no infinite entry, and are not empty."""
        x = x.flatten(1)
        return ~torch.isinf(x).any(dim=1) & torch.isfinite(x).any(dim=1)

    def mass(self, z: Tensor, num_rows: int, accept: Accept, **options: Any) -> Mass:
        """Estimate the mass inside the support of a prior once for all observations."""
        own = super().mass(z[:1], 1, accept, **options)
        return Mass(own.mass.expand(num_rows), own.variance.expand(num_rows))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        # `to` calls this for each module, but a distribution is not a module.
        moved = super()._apply(fn, recurse)
        self.prior = move_distribution_to_device(self.prior, str(self.device))
        return moved


def prior_sample(prior: Distribution, sample_shape: torch.Size) -> Tensor:
    """Draw from a prior over parameters of shape ``(d,)``, ``(*sample_shape, d)``."""
    # sbi's MultipleIndependent takes sample shapes with one dimension only.
    theta = prior.sample(torch.Size((sample_shape.numel(),)))
    return theta.reshape(*sample_shape, *theta.shape[1:])


def prior_log_prob(prior: Distribution, theta: Tensor) -> Tensor:
    r"""Return the log density of the prior, :math:`-\infty` outside its support.

    On a bound it is that just inside.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        theta: Parameters, shape ``(*batch, d)``.

    Returns:
        Shape ``(*batch)``. Gradients with respect to theta exist even where the density
        is flat; they are zero there.
    """
    shape = theta.shape[:-1]
    # sbi's MultipleIndependent takes theta with at most two dimensions.
    theta = theta.reshape(-1, theta.shape[-1])
    theta = theta if theta.is_floating_point() else theta.float()
    safe, inside = moved_inside(prior, theta)
    log_prob = prior.log_prob(off_bounds(prior, safe)) + 0.0 * safe.sum(dim=-1)
    return log_prob.where(inside, -torch.inf).reshape(shape)


class PriorPosterior(MixturePosterior):
    r"""The prior :math:`p(\theta)`, in the form of an sbi posterior that ignores x.

    It is calibrated whenever the prior is right. An estimate that has learnt something
    from x has a higher log posterior probability. ``sample`` and ``log_prob`` need no
    observation, and the batched methods take observations of any shape.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``. It is copied.

    Raises:
        InvalidInputError: If the prior is not a torch distribution. In ``map``, if sbi
            cannot transform the prior to an unbounded space.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> posterior = PriorPosterior(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> posterior.sample_batched((5,), x=torch.zeros(3, 7)).shape
        torch.Size([5, 3, 2])
    """

    def __init__(self, prior: Any) -> None:
        if not isinstance(prior, Distribution) or len(prior.event_shape) != 1:
            raise InvalidInputError(
                "Expected `prior` to be a torch distribution over vectors; got "
                f"{type(prior).__name__}. Use `sbi.utils.process_prior(prior)[0]`."
            )
        density = Prior(prior, (0,))
        self._reason_without_map = ""
        try:
            super().__init__(density, density.prior)
        except Exception as error:  # sbi raises all kinds; only map() needs it
            self._reason_without_map = f"{type(error).__name__}: {error}"
            super().__init__(density, density.prior, enable_transform=False)
        describe(self, "It is the prior and ignores x.")

    def _one_x(self, x: Any) -> Tensor:
        return torch.empty(1, 0, device=self.posterior_estimator.device)

    def _batch_of_x(self, x: Any) -> Tensor:
        count = len(as_numbers("x", x))
        return torch.empty(count, 0, device=self.posterior_estimator.device)

    def map(self, *args: Any, **kwargs: Any) -> Tensor:
        """Return the mode of the prior, as in sbi; any point if it is uniform.

        Raises:
            InvalidInputError: If sbi cannot transform the prior.
        """
        if self._reason_without_map:
            raise InvalidInputError(
                "Expected a prior that sbi can transform to an unbounded space; got "
                f"{type(self.prior).__name__} ({self._reason_without_map})."
            )
        return super().map(*args, **kwargs)
