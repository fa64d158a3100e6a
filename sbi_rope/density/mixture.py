"""Mixtures of densities, and the average of posteriors."""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.density.base import Accept, Density
from sbi_rope.density.flow import Flow
from sbi_rope.density.posterior import MixturePosterior
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.sbi import check_density, estimator_of
from sbi_rope.utils.errors import InvalidInputError, shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import check

# Draws of the first prior, at which the others must have the same density.
NUM_FROM_PRIOR = 100


class Mixture(Density):
    r"""A weighted sum of densities.

    .. math:: \sum_k w_k\, q_k(\theta \mid x)

    Args:
        parts: :math:`q_k`. The parts of a mixture among them become parts of this one.
            All have the same shapes of theta and x, and belong to the same batch.
        weights: :math:`w_k`, with a sum of one. A part of weight zero is left out.
    """

    weights: Tensor

    def __init__(
        self, parts: Sequence[Density], weights: Sequence[float] | Tensor
    ) -> None:
        first = parts[0]
        super().__init__(first.input_shape, first.condition_shape)
        flat: list[tuple[Density, float]] = []
        shares = torch.as_tensor(weights, dtype=torch.double).tolist()
        for part, weight in zip(parts, shares, strict=True):
            shapes = part.input_shape, part.condition_shape
            if shapes != (expected := (self.input_shape, self.condition_shape)):
                raise InvalidInputError(
                    "Expected posteriors with theta and x of the same shapes "
                    f"{expected}; got {shapes}."
                )
            of_part = part.weights.tolist() if isinstance(part, Mixture) else [1.0]
            own = part.parts if isinstance(part, Mixture) else [part]
            pairs = zip(own, of_part, strict=True)
            flat += [(one, weight * w) for one, w in pairs if weight * w]
        self.parts: Any = nn.ModuleList(part for part, _ in flat)
        used = torch.tensor([w for _, w in flat], dtype=torch.double)
        self.register_buffer("weights", used.to(first.device))
        batches = [part.x_o for part in self.coupled]
        if any(not torch.equal(x_o, batches[0]) for x_o in batches[1:]):
            raise InvalidInputError(
                "Expected the same `x_o` in all coupled parts; got different ones."
            )

    @property
    def coupled(self) -> list[Any]:
        """The parts that belong to a batch of observations."""
        return [one for part in self.parts for one in part.coupled]

    def embed(self, x: Tensor) -> list[Any]:
        """Return what each part keeps of observations."""
        return [part.embed(x) for part in self.parts]

    def log_q(self, theta: Tensor, z: list[Any]) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        log_q = [
            part.log_q(theta, own) for part, own in zip(self.parts, z, strict=True)
        ]
        return torch.stack(log_q, dim=-1).add(self.weights.log()).logsumexp(dim=-1)

    @torch.no_grad()
    def draw(self, z: list[Any], row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        uniform = torch.rand(len(row), dtype=torch.double)
        chosen = torch.searchsorted(self.weights.cpu().cumsum(0), uniform)
        chosen = chosen.clamp_max(len(z) - 1).to(row.device)
        theta = torch.empty(len(row), *self.input_shape, device=row.device)
        for k, (part, own) in enumerate(zip(self.parts, z, strict=True)):
            mine = (chosen == k).nonzero().flatten()
            if len(mine):
                theta[mine] = part.draw(own, row[mine])
        return theta

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations can be embedded by all parts."""
        return torch.stack([part.readable(x) for part in self.parts]).all(dim=0)

    def mass(
        self, z: list[Any], num_rows: int, accept: Accept, **options: Any
    ) -> Tensor:
        """Return the weighted sum of masses, each of its share of the draws."""
        parts = zip(self.parts, self.weights.tolist(), z, strict=True)
        of_each = [
            part.mass(own, num_rows, accept, **(options | {"share": weight, "seed": k}))
            for k, (part, weight, own) in enumerate(parts)
        ]
        return torch.stack(of_each, dim=1) @ self.weights

    def restricted_to(self, index: int) -> "Mixture":
        """Return the same mixture for one observation of the batch alone."""
        return Mixture([part.restricted_to(index) for part in self.parts], self.weights)


def density_of(posterior: Any, *, what: str = "a posterior") -> Density:
    """Return a copy of the density of a posterior, of this package or of NPE."""
    if isinstance(posterior, MixturePosterior):
        return copy.deepcopy(posterior.posterior_estimator)
    return Flow.of([check_density(estimator_of(posterior), what=what)])


def average(
    posteriors: Sequence[Any], *, weights: Sequence[float] | None = None
) -> MixturePosterior:
    r"""Return the weighted average of posteriors that belong to the same prior.

    .. math::
        p(\theta \mid x) \propto \mathbf{1}[\theta \in \operatorname{supp} p]
        \sum_m w_m\, q_m(\theta \mid x)

    An ensemble of NPEs is repaired in this way, every member by itself. The average is
    normalised as a whole, so that a member with much of its mass outside the prior
    counts for less.

    Args:
        posteriors: What ``stack``, ``RoPE.build_posterior`` or a trainer returns, or
            posteriors of NPE. They are copied. Those that belong to a batch have to
            belong to the same batch.
        weights: One for each posterior, with a sum of one; equal if None.

    Raises:
        InvalidInputError: If shapes, batches or priors differ, or weights do not fit.
        UnsupportedPosteriorError: If one of them has no density or no embedding of x.

    Example:
        >>> import torch
        >>> from sbi.inference import NPE
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> members = []
        >>> for _ in range(2):
        ...     npe = NPE(prior, density_estimator="mdn", show_progress_bars=False)
        ...     theta = prior.sample((100,))
        ...     npe = npe.append_simulations(theta, theta + torch.randn(100, 1))
        ...     _ = npe.train(max_num_epochs=1)
        ...     members.append(npe.build_posterior())
        >>> posterior = average(members, weights=[0.3, 0.7])
        >>> posterior.sample((5,), x=torch.ones(1)).shape
        torch.Size([5, 1])
    """
    check("posteriors", posteriors, list | tuple)
    if not posteriors:
        raise InvalidInputError("Expected at least one of `posteriors`; got none.")
    shares = [1.0 / len(posteriors)] * len(posteriors)
    if weights is not None:
        shares = [float(weight) for weight in weights]
        fits = len(shares) == len(posteriors) and min(shares) >= 0
        if not fits or not math.isclose(sum(shares), 1.0, abs_tol=1e-6):
            raise InvalidInputError(
                f"Expected {len(posteriors)} `weights` from 0 on with a sum of 1; got "
                f"{shown(weights)}."
            )
    mixture = Mixture([density_of(posterior) for posterior in posteriors], shares)
    first, *others = (PriorDistribution(one.prior) for one in posteriors)
    with seeded(0):
        theta = first.sample((NUM_FROM_PRIOR,))
    for number, prior in enumerate(others, start=1):
        if not torch.allclose(prior.log_prob(theta), first.log_prob(theta), atol=1e-3):
            raise InvalidInputError(
                "Expected `posteriors` with the same prior; got another one in "
                f"posteriors[{number}]."
            )
    averaged = MixturePosterior(
        mixture, first, enable_transform=posteriors[0].enable_transform
    )
    for names in ("parameter_names", "x_names"):
        own, *others = (getattr(one, names, None) for one in posteriors)
        if all(other == own for other in others):
            setattr(averaged, names, own)
    return averaged
