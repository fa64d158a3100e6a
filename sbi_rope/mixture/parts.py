"""The parts of a mixture: a density, and what gives an observation its contexts."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    embed,
    embedding_of,
    headless,
)
from sbi_rope.errors import InvalidInputError, UnsupportedPosteriorError

__all__ = [
    "DTYPE",
    "Mixing",
    "OwnContexts",
    "Part",
    "Rows",
    "equal_rows",
    "part_of",
]

# sbi converts every x to it, and its estimators know no other.
DTYPE = torch.float32


@dataclass(frozen=True, eq=False)
class Rows:
    """The weighted contexts of a block of observations.

    Attributes:
        weights: Rows that sum to one, shape ``(b, c)``.
        contexts: Those of all observations, shape ``(c, l)``, or each one's own, shape
            ``(b, c, l)``.
    """

    weights: Tensor
    contexts: Tensor

    def at(self, row: Tensor, column: Tensor) -> Tensor:
        """Return the contexts of some entries of the weights, ``(n, l)``."""
        if self.contexts.ndim == 2:
            return self.contexts[column]
        return self.contexts[row, column]


class Mixing(nn.Module, ABC):
    r"""What gives an observation its contexts :math:`s_j(x)` and their weights.

    To implement one, call the constructor with the shape of one observation and the
    number of contexts, and define the two methods.

    Attributes:
        event_shape: Shape of one observation.
        num_contexts: Contexts of each observation, c.
    """

    def __init__(self, event_shape: Sequence[int], num_contexts: int) -> None:
        super().__init__()
        self.event_shape = torch.Size(event_shape)
        self.num_contexts = num_contexts

    @property
    def contexts(self) -> Tensor | None:
        """Contexts that all observations share, ``(c, l)``; None if each has its own.

        The mass of a shared one inside the prior's support is estimated once.
        """
        return None

    @abstractmethod
    def features(self, x: Tensor) -> Tensor:
        """Return what is computed once of observations and held for all of them.

        Shapes are ``(n, *event)`` to ``(n, ...)``.
        """

    @abstractmethod
    def rows(self, features: Tensor) -> Rows:
        """Return the weighted contexts of a block of observations."""


class OwnContexts(Mixing):
    r"""The embeddings of the observation itself, :math:`h_k(x)`, with equal weights.

    With one net it makes a part of any amortised posterior. With K nets the density is
    averaged over K embeddings.

    Args:
        nets: The embedding nets, with outputs of one shape ``(n, l)``.
        event_shape: Shape of one observation.
    """

    def __init__(self, nets: Sequence[nn.Module], event_shape: Sequence[int]) -> None:
        if not len(nets):
            raise InvalidInputError("Expected at least one embedding net; got none.")
        super().__init__(event_shape, len(nets))
        self.nets = nn.ModuleList(nets)

    def features(self, x: Tensor) -> Tensor:
        """Embed observations, ``(n, *event)`` to ``(n, K, l)``."""
        return torch.stack([embed(net, x) for net in self.nets], dim=1)

    def rows(self, features: Tensor) -> Rows:
        """Weigh all embeddings of an observation equally."""
        return equal_rows(features)


def equal_rows(contexts: Tensor) -> Rows:
    """Return own contexts ``(b, c, l)`` with equal weights."""
    shape = contexts.shape[:2]
    return Rows(contexts.new_full(shape, 1 / shape[1], dtype=torch.double), contexts)


class Part(nn.Module):
    r"""A density that is mixed over contexts.

    .. math:: \sum_j a_j(x)\, q(\theta \mid s_j(x))

    Args:
        density: :math:`q(\theta \mid s)`, an estimator conditioned on contexts.
        mixing: The weights and contexts of an observation.
    """

    density: ConditionalDensityEstimator
    mixing: Mixing

    def __init__(self, density: ConditionalDensityEstimator, mixing: Mixing) -> None:
        super().__init__()
        self.density = density
        self.mixing = mixing

    def log_prob(self, theta: Tensor, contexts: Tensor) -> Tensor:
        """Return the log densities of pairs, ``(n, d)`` and ``(n, l)`` to ``(n,)``."""
        return self.density.log_prob(theta[None], contexts)[0]

    def sample(self, contexts: Tensor) -> Tensor:
        """Draw once given each context, ``(n, l)`` to ``(n, d)``."""
        return self.density.sample(torch.Size((1,)), contexts)[0]


def part_of(estimator: ConditionalEstimator) -> Part:
    r"""Return a trained estimator of NPE, :math:`q(\theta \mid h(x))`, as a part.

    It is copied: the user may train it on, or put it into training mode.

    Raises:
        UnsupportedPosteriorError: If it has no density or no embedding of x.
    """
    if not isinstance(estimator, ConditionalDensityEstimator):
        raise UnsupportedPosteriorError(
            "Expected an estimator with a density, such as those of NPE; got "
            f"{type(estimator).__name__}. Train NPE instead of FMPE or NPSE."
        )
    own = copy.deepcopy(estimator).requires_grad_(requires_grad=False)
    contexts = OwnContexts([embedding_of(own)], estimator.condition_shape)
    return Part(headless(own), contexts).eval()
