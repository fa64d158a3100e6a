"""A trained NPE, split into its embedding net and its density."""

import copy
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    MixedDensity,
    VectorFieldDensity,
    check_rows_apart,
    check_weights_of,
    copy_of_prior,
    device_of,
    dtype_of,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
    readable,
    with_embedding,
)
from sbi_rope._validation import check_readable
from sbi_rope.errors import InvalidInputError, UnsupportedPosteriorError
from sbi_rope.settings import names_of
from sbi_rope.tensors import as_batch, as_numbers

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
        parameter_names: The names; None if there are none.

    Raises:
        UnsupportedPosteriorError: If the posterior has no embedding to work with, is
            not in float32, has weights that are not finite, or embeds a row of a batch
            differently among other rows.
        InvalidInputError: If the names are not strings.
        InvalidInputError: If there are not as many names as parameters, or two are
            equal, or the prior has another number of parameters than the estimator.
    """

    def __init__(self, posterior: Any, parameter_names: Any = None) -> None:
        estimator = estimator_of(posterior)
        embedding_of(estimator)
        check_weights_of(estimator)
        if dtype_of(estimator) != torch.float32:
            raise UnsupportedPosteriorError(
                f"Expected an estimator in float32; got {dtype_of(estimator)}. sbi "
                "converts every x to float32; convert the estimator with `.float()`."
            )
        self.estimator = (
            copy.deepcopy(estimator).eval().requires_grad_(requires_grad=False)
        )
        self._posterior: Any = posterior_from(posterior, self.estimator)
        self.prior = copy_of_prior(posterior.prior)
        _check_size_of_prior(self.prior, estimator.input_shape)
        self.h = embedding_of(self.estimator)
        self._q = headless(self.estimator)
        check_rows_apart(self.h, self.event_shape, device_of(estimator))
        self.like = torch.empty(
            0,
            *estimator.input_shape,
            dtype=dtype_of(estimator),
            device=device_of(estimator),
        )
        self.parameter_names: tuple[str, ...] | None = None
        if parameter_names is not None:
            self.parameter_names = names_of(parameter_names, self.like.shape[1])

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
        usable = torch.isfinite(torch.linalg.vector_norm(embedded, dim=1))
        if not usable.all():
            rows = (~usable).nonzero().flatten()
            largest = float(x[rows[0]].abs().max())
            raise InvalidInputError(
                f"Expected `{name}` with a finite embedding; got NaN, Inf or numbers "
                f"too large to compare for {len(rows)} of {len(x)} rows (first: "
                f"{rows[:5].tolist()}, with values of up to {largest:.2g}). Remove or "
                "repair these rows."
            )
        return embedded

    def checked_x(self, name: str, x: Any) -> Tensor:
        """Return a copy of a user's observations, in the estimator's dtype."""
        x = self._checked(name, x, self.event_shape)
        check_readable(name, x, self.readable(x))
        return x

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations h can read, ``(n,)``; some nets can read NaN."""
        return readable(self.h, x)

    def _checked(self, name: str, value: Any, event_shape: torch.Size) -> Tensor:
        value = as_batch(
            name,
            as_numbers(name, value, device=self.like.device),
            event_shape,
            finite=False,
        )
        # Numbers that float32 cannot hold become Inf.
        return value.detach().to(self.like.dtype, copy=True)


def _check_size_of_prior(prior: Any, input_shape: torch.Size) -> None:
    """Raise unless draws of the prior have the shape of the estimator's parameters."""
    with seeded(0):
        shape = prior.sample(torch.Size((1,))).shape[1:]
    if tuple(shape) != tuple(input_shape):
        raise InvalidInputError(
            f"Expected a prior of {input_shape.numel()} parameters, as NPE was trained "
            f"with; got one whose draws have shape {tuple(shape)}. Pass the prior of "
            "the simulations to `NPE(prior)`, or to `build_posterior(prior=...)`."
        )
