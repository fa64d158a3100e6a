"""A trained NPE, split into its embedding net and its density."""

import copy
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    MixedDensity,
    VectorFieldDensity,
    check_rows_apart,
    device_of,
    dtype_of,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
    readable,
    standardisation_of,
    with_embedding,
)
from sbi_rope.errors import InvalidInputError
from sbi_rope.settings import names_of
from sbi_rope.tensors import as_batch, rows_with

__all__ = ["TrainedNPE"]


class TrainedNPE:
    r"""A copy of a trained estimator :math:`q(\theta \mid h(x))`, in its two parts.

    Training, or moving a posterior to another device, must not change the user's
    estimator and prior. They are therefore copied, and all that is returned is a copy
    again.

    Args:
        posterior: What ``NPE(...).build_posterior()`` returns, or the posterior of
            MNPE, FMPE or NPSE.
        parameter_names: One name for each parameter, if they have names.

    Attributes:
        estimator: The copy of the estimator, in evaluation mode.
        prior: The copy of the prior.
        h: The embedding net of the copy, with sbi's standardising layer.
        like: An empty tensor of shape ``(0, d)`` with the dtype and device of the
            estimator.
        parameter_names: The names of the parameters; None if there are none.
        x_names: The names of the columns of tables of x; None if they are not known.

    Raises:
        UnsupportedPosteriorError: If the posterior has no embedding to work with, has
            weights that are not finite, or embeds a row of a batch differently among
            other rows.
        InvalidInputError: If there are not as many different names as parameters.
    """

    def __init__(self, posterior: Any, parameter_names: Any = None) -> None:
        estimator = copy.deepcopy(estimator_of(posterior)).eval()
        self.estimator = estimator.requires_grad_(requires_grad=False)
        self.h = embedding_of(estimator)
        self._q = headless(estimator)
        self._posterior: Any = posterior_from(posterior, estimator)
        self.prior = copy.deepcopy(posterior.prior)
        self.like = torch.empty(
            0,
            *estimator.input_shape,
            dtype=dtype_of(estimator),
            device=device_of(estimator),
        )
        self.parameter_names: tuple[str, ...] | None = None
        if parameter_names is not None:
            self.parameter_names = names_of(parameter_names, self.like.shape[1])
        self.x_names: tuple[str, ...] | None = None
        generator = torch.Generator().manual_seed(0)
        x = torch.randn(4, *self.event_shape, generator=generator).to(self.like)
        mean, std = standardisation_of(self.h) or (0.0, 1.0)
        check_rows_apart(self.h, mean + std * x)

    @property
    def event_shape(self) -> torch.Size:
        """The shape of one observation."""
        return self.estimator.condition_shape

    @property
    def is_mixed(self) -> bool:
        """Whether some parameters are discrete."""
        return isinstance(self._q, MixedDensity)

    @property
    def enable_transform(self) -> bool:
        """Whether sbi's ``map`` searches in an unbounded space."""
        return self._posterior.enable_transform

    def posterior(self, embedding_net: nn.Module | None = None) -> Any:
        """Return a copy of the sbi posterior.

        Args:
            embedding_net: The embedding net of the copy; h if None.
        """
        estimator = self.estimator
        if embedding_net is not None:
            estimator = with_embedding(estimator, embedding_net)
        return posterior_from(self._posterior, copy.deepcopy(estimator))

    def density(self) -> ConditionalDensityEstimator:
        r"""Return a copy of :math:`q(\theta \mid s)`, given an embedding s."""
        density = self._q
        if not isinstance(density, ConditionalDensityEstimator):
            sample_with = self._posterior.sample_with
            density = VectorFieldDensity(density, self.prior, sample_with)
        return copy.deepcopy(density)

    def embed(self, name: str, x: Tensor, embedding_net: nn.Module) -> Tensor:
        """Return the embeddings of a user's observations, shape ``(n, l)``.

        Raises:
            InvalidInputError: If an embedding, or its length, is not finite.
        """
        embedded = embed(embedding_net, x)
        bad = ~torch.isfinite(torch.linalg.vector_norm(embedded, dim=1))
        if bad.any():
            raise InvalidInputError(
                f"Expected `{name}` with finite embeddings; got NaN, Inf or too large "
                f"numbers in {rows_with(bad)}."
            )
        return embedded

    def as_x(self, name: str, x: Any) -> Tensor:
        """Return a copy of a user's observations, if the embedding net can read them.

        Raises:
            InvalidInputError: If they hold no numbers, their shape or device does not
                fit, or h cannot read them.
        """
        x = as_batch(
            name,
            x,
            self.event_shape,
            device=self.like.device,
            names=self.x_names,
            finite=False,
        ).to(self.like.dtype, copy=True)
        if not (can_read := self.readable(x)).all():
            raise InvalidInputError(
                f"Expected `{name}` that the embedding net of NPE can read; got NaN or "
                f"Inf in {rows_with(~can_read)}."
            )
        return x

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations h can read, ``(n,)``; some nets can read NaN."""
        return readable(self.h, x)
