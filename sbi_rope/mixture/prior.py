"""The prior as a part of a mixture: a density that does not depend on x."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._bounds import moved_inside, off_bounds
from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator, move_distribution_to_device
from sbi_rope.mixture.parts import Mixing, Part, Rows, has_entries

__all__ = ["PriorDensity", "part_of_prior", "prior_log_prob", "prior_sample"]


def part_of_prior(prior: Distribution, event_shape: Sequence[int]) -> Part:
    """Return the prior as a part that ignores the observation.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``; it is copied.
        event_shape: Shape of one observation.
    """
    density = PriorDensity(copy.deepcopy(prior))
    return Part(density, NoEmbedding(event_shape, device=density.placeholder.device))


class NoEmbedding(Mixing):
    """One embedding of width zero, the same for all observations.

    Args:
        event_shape: Shape of one observation.
        device: The device of the density.
    """

    empty: Tensor

    def __init__(self, event_shape: Sequence[int], *, device: torch.device) -> None:
        super().__init__(event_shape, num_embeddings=1)
        self.register_buffer("empty", torch.empty(1, 0, device=device))

    @property
    def embeddings(self) -> Tensor:
        """The empty embedding, shape ``(1, 0)``."""
        return self.empty

    def embed(self, x: Tensor) -> Tensor:
        """Return an empty embedding for each observation, ``(n, 0)``."""
        return x.new_empty(len(x), 0)

    def rows(self, embedded: Tensor) -> Rows:
        """Return a weight of one for each observation."""
        return Rows(embedded.new_ones(len(embedded), 1, dtype=torch.double), self.empty)

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations have no entry that is infinite, and are not empty."""
        return has_entries(x)


class PriorDensity(ConditionalDensityEstimator):
    r"""The prior :math:`p(\theta)`, in the form of an estimator of sbi.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
    """

    placeholder: Tensor

    def __init__(self, prior: Distribution) -> None:
        super().__init__(nn.Identity(), prior.event_shape, torch.Size((0,)))
        self.prior = prior
        with seeded(0):
            like = prior.sample(torch.Size((1,)))
        # A distribution has no device. This tensor is on the device of its draws.
        self.register_buffer("placeholder", torch.empty(0, device=like.device))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log densities of theta, ``(S, B, d)`` to ``(S, B)``."""
        return prior_log_prob(self.prior, input)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw for each condition, ``(*sample_shape, B, d)``."""
        shape = torch.Size((*sample_shape, len(condition)))
        return prior_sample(self.prior, shape).to(condition)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        # `to` calls this for each module, but a distribution is not a module.
        moved = super()._apply(fn, recurse)
        device = self.placeholder.device
        self.prior = move_distribution_to_device(self.prior, str(device))
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
