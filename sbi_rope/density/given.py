"""Any density of a user, and posteriors as densities."""

import copy
from typing import Any

import torch
from torch import Tensor

from sbi_rope._sbi import check_density, estimator_of
from sbi_rope.density.base import Density
from sbi_rope.density.flow import Flow
from sbi_rope.density.posterior import MixturePosterior
from sbi_rope.errors import InvalidInputError

__all__ = ["Given", "density_of"]


class Given(Density):
    r"""A density that somebody else computes.

    Args:
        own: Has the methods ``log_prob(theta, x)``, shapes ``(S, B, d)`` and
            ``(B, *event)`` to ``(S, B)``, and ``sample((n,), x)``, ``(n, B, d)``.
        theta: Some parameters, shape ``(m, d)``, and
        x: their observations, shape ``(m, *event)``, to try it on.

    Raises:
        InvalidInputError: If the shapes that it returns do not fit.
    """

    placeholder: Tensor

    def __init__(self, own: Any, theta: Tensor, x: Tensor) -> None:
        super().__init__(theta.shape[1:], x.shape[1:])
        self.own = own
        self.register_buffer("placeholder", theta.new_empty(0))
        if not hasattr(own, "log_prob") or not hasattr(own, "sample"):
            raise InvalidInputError(
                "Expected a density with `log_prob(theta, x)` and `sample(shape, x)`; "
                f"got {type(own).__name__}."
            )
        with torch.no_grad():
            shapes = (
                tuple(own.log_prob(theta[None], x).shape),
                tuple(own.sample(torch.Size((3,)), x).shape),
            )
        expected = ((1, len(x)), (3, *theta.shape))
        if shapes != expected:
            raise InvalidInputError(
                f"Expected log_prob(theta, x) of shape {expected[0]} and "
                f"sample((3,), x) of shape {expected[1]} for {len(x)} observations; "
                f"got {shapes[0]} and {shapes[1]}."
            )

    def embed(self, x: Tensor) -> Tensor:
        """Return the observations themselves."""
        return x

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        return self.own.log_prob(theta, z).double()

    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        rows, place, counts = row.unique(return_inverse=True, return_counts=True)
        draws = self.own.sample(torch.Size((int(counts.max()),)), z[rows])
        order = place.argsort(stable=True)
        number = torch.arange(len(row), device=row.device)
        number = number - (counts.cumsum(0) - counts)[place[order]]
        return draws[number, place[order]][order.argsort()]


def density_of(posterior: Any, *, what: str = "a posterior") -> Density:
    """Return a copy of the density of a posterior, of this package or of NPE.

    Raises:
        UnsupportedPosteriorError: If it has no density or no embedding of x.
    """
    if isinstance(posterior, MixturePosterior):
        return copy.deepcopy(posterior.posterior_estimator)
    return Flow.of([check_density(estimator_of(posterior), what=what)])
