"""The parts of a mixture: a density, and the embeddings it is mixed over."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    check_density,
    embed,
    embedding_of,
    headless,
    readable,
)
from sbi_rope.errors import InvalidInputError, SamplingError
from sbi_rope.tensors import as_numbers

__all__ = [
    "DTYPE",
    "Mixing",
    "OwnEmbeddings",
    "Part",
    "Rows",
    "equal_rows",
    "has_entries",
    "parameters_of",
    "part_of",
]

# sbi converts every x to this dtype, and its estimators work in no other.
DTYPE = torch.float32


@dataclass(frozen=True, eq=False)
class Rows:
    """The weighted embeddings of a block of observations.

    Attributes:
        weights: Rows that sum to one, shape ``(b, c)``.
        embeddings: Embeddings that all observations share, shape ``(c, l)``, or those
            of each observation, shape ``(b, c, l)``.
    """

    weights: Tensor
    embeddings: Tensor

    def at(self, row: Tensor, column: Tensor) -> Tensor:
        """Return the embeddings of some entries of the weights, ``(n, l)``."""
        if self.embeddings.ndim == 2:
            return self.embeddings[column]
        return self.embeddings[row, column]


class Mixing(nn.Module, ABC):
    r"""The embeddings :math:`s_j(x)` of an observation, with weights :math:`a_j(x)`.

    A subclass calls the constructor with the shape of one observation and the number of
    embeddings, and defines :meth:`embed` and :meth:`rows`.

    Attributes:
        event_shape: Shape of one observation.
        num_embeddings: The number of embeddings of each observation, c.
    """

    def __init__(self, event_shape: Sequence[int], num_embeddings: int) -> None:
        super().__init__()
        self.event_shape = torch.Size(event_shape)
        self.num_embeddings = num_embeddings

    @property
    def embeddings(self) -> Tensor | None:
        """Embeddings that all observations share, ``(c, l)``; None if each has its own.

        Given a shared embedding, the mass inside the prior's support is estimated once.
        """
        return None

    @abstractmethod
    def embed(self, x: Tensor) -> Tensor:
        """Compute what is kept of observations, ``(n, *event)`` to ``(n, ...)``."""

    @abstractmethod
    def rows(self, embedded: Tensor) -> Rows:
        """Return the weighted embeddings of a block of observations."""

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations can be embedded, ``(n, *event)`` to ``(n,)``.

        Those that are finite, unless a subclass can do with missing entries (NaN).
        """
        return torch.isfinite(x).flatten(1).all(dim=1)


class OwnEmbeddings(Mixing):
    r"""The embeddings of the observation itself, :math:`h_k(x)`, with equal weights.

    With one net, any amortised posterior becomes a part in this way. With K nets the
    density is averaged over K embeddings.

    Args:
        nets: The embedding nets, with outputs of one shape ``(n, l)``.
        event_shape: Shape of one observation.
    """

    def __init__(self, nets: Sequence[nn.Module], event_shape: Sequence[int]) -> None:
        super().__init__(event_shape, len(nets))
        self.nets = nn.ModuleList(nets)

    def embed(self, x: Tensor) -> Tensor:
        """Embed observations, ``(n, *event)`` to ``(n, K, l)``."""
        return torch.stack([embed(net, x) for net in self.nets], dim=1)

    def rows(self, embedded: Tensor) -> Rows:
        """Weigh all embeddings of an observation equally."""
        return equal_rows(embedded)

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations all nets can read."""
        return torch.stack([readable(net, x) for net in self.nets]).all(dim=0)


def has_entries(x: Tensor) -> Tensor:
    """Tell which rows have no entry that is infinite, and are not empty, ``(n,)``."""
    x = x.flatten(1)
    return ~torch.isinf(x).any(dim=1) & torch.isfinite(x).any(dim=1)


def equal_rows(embeddings: Tensor) -> Rows:
    """Return the embeddings ``(b, c, l)`` of each observation with equal weights."""
    shape = embeddings.shape[:2]
    return Rows(
        embeddings.new_full(shape, 1 / shape[1], dtype=torch.double), embeddings
    )


class Part(nn.Module):
    r"""A density that is mixed over embeddings.

    .. math:: \sum_j a_j(x)\, q(\theta \mid s_j(x))

    Args:
        density: :math:`q(\theta \mid s)`, an estimator conditioned on embeddings.
        mixing: The weights and embeddings of an observation.
    """

    density: ConditionalDensityEstimator
    mixing: Mixing

    def __init__(self, density: ConditionalDensityEstimator, mixing: Mixing) -> None:
        super().__init__()
        self.density = density
        self.mixing = mixing

    def log_prob(self, theta: Tensor, embeddings: Tensor) -> Tensor:
        """Return the log densities of pairs, ``(n, d)`` and ``(n, l)`` to ``(n,)``."""
        return self.density.log_prob(theta[None], embeddings)[0]

    def sample(self, embeddings: Tensor) -> Tensor:
        """Draw once given each embedding, ``(n, l)`` to ``(n, d)``.

        Raises:
            SamplingError: If the density is not finite given an embedding.
        """
        try:
            return self.density.sample(torch.Size((1,)), embeddings)[0]
        except ValueError as error:  # of sbi's mixtures of Gaussians
            raise SamplingError(
                "Expected a density that can be sampled given all observations; got "
                f"{error}. Leave out observations that are far from all simulations."
            ) from error


def part_of(estimator: ConditionalEstimator) -> Part:
    r"""Return a trained estimator of NPE, :math:`q(\theta \mid h(x))`, as a part.

    The estimator is copied, because the user may train it further or put it into
    training mode.

    Raises:
        UnsupportedPosteriorError: If it has no density or no embedding of x.
    """
    check_density(estimator)
    own = copy.deepcopy(estimator).requires_grad_(requires_grad=False)
    embeddings = OwnEmbeddings([embedding_of(own)], estimator.condition_shape)
    return Part(headless(own), embeddings).eval()


def parameters_of(
    theta: Any, dim: int, *, batched: bool, names: Sequence[str] | None = None
) -> Tensor:
    """Return the parameters whose density is asked for, in float32.

    A bound of the prior is one in float32 only: 0.1 of float64 is below the 0.1 of a
    prior.

    Args:
        theta: What the user gave, shape ``(n, d)`` or ``(d,)``.
        dim: The number of parameters, d.
        batched: Whether theta belongs to a batch of B observations. Its shape is then
            ``(B, d)``, or ``(S, B, d)`` for S parameters of each observation.
        names: The names of the parameters.

    Raises:
        InvalidInputError: If the shape does not fit, or a number is NaN.
    """
    numbers = as_numbers("theta", theta, names=names)
    theta = theta if isinstance(theta, Tensor) else numbers  # which has gradients
    shape = tuple(theta.shape)
    if theta.ndim not in ((2, 3) if batched else (1, 2)) or shape[-1] != dim:
        expected = f"(B, {dim}) or (S, B, {dim})" if batched else f"(n, {dim})"
        raise InvalidInputError(f"Expected `theta` of shape {expected}; got {shape}.")
    if torch.isnan(theta).any() or not len(theta):
        raise InvalidInputError("Expected `theta` with numbers; got NaN or none.")
    return theta.to(DTYPE)
