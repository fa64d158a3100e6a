"""The prior in the form of an sbi posterior."""

import copy
from pathlib import Path
from typing import Any

import torch
from sbi.utils import mcmc_transform
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import BasePotential, NeuralPosterior, describe
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture.parts import parameters_of
from sbi_rope.mixture.prior import prior_log_prob, prior_sample
from sbi_rope.saving import save
from sbi_rope.tensors import as_batch

__all__ = ["PriorPosterior"]


class PriorPosterior(NeuralPosterior):
    r"""The prior :math:`p(\theta)`, in the form of an sbi posterior that ignores x.

    It is calibrated whenever the prior is right. An estimate that has learnt something
    from x has a higher log posterior probability.

    ``sample`` and ``log_prob`` need no observation. The batched methods return one set
    of samples, or one density, for each row of ``x``, and never read its values.
    ``potential`` needs an ``x`` or a default x, as in sbi. ``map`` searches the mode of
    the prior by sbi's gradient ascent; for a uniform prior it returns any point. It
    needs a prior that sbi can transform to an unbounded space. The other methods do
    not.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``. It is copied.

    Raises:
        InvalidInputError: If the prior is not a torch distribution.

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
        prior = copy.deepcopy(prior)
        transform, self._reason_without_map = None, ""
        with seeded(0):  # both draw from the prior to look at it
            device = prior.sample(torch.Size((1,))).device
            try:
                transform = mcmc_transform(prior, device=str(device))
            except Exception as error:  # sbi raises all kinds; only map() needs it
                self._reason_without_map = f"{type(error).__name__}: {error}"
        super().__init__(
            potential_fn=_PriorPotential(prior, device=device),
            theta_transform=transform,
        )
        self.prior = prior
        describe(self, "It is the prior and ignores x.")

    def sample(
        self,
        sample_shape: Any = (),
        x: Tensor | None = None,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        **kwargs: Any,
    ) -> Tensor:
        """Draw from the prior, ``(*sample_shape, d)``; other arguments are ignored."""
        return prior_sample(self.prior, torch.Size(sample_shape))

    def sample_batched(
        self,
        sample_shape: Any,
        x: Tensor,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        **kwargs: Any,
    ) -> Tensor:
        """Draw from the prior for each row of ``x``, ``(*sample_shape, n, d)``.

        Options of other posteriors' samplers are accepted and ignored, as sbi's base
        class asks.
        """
        shape = torch.Size((*sample_shape, len(as_batch("x", x, finite=False))))
        return prior_sample(self.prior, shape)

    def log_prob(
        self,
        theta: Tensor,
        x: Tensor | None = None,
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Return the log density, :math:`-\infty` outside the support, ``(n,)``."""
        theta = parameters_of(theta, self.prior.event_shape[0], batched=False)
        return self.potential_fn(
            torch.atleast_2d(theta), track_gradients=track_gradients
        )

    def log_prob_batched(
        self,
        theta: Tensor,
        x: Tensor,
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        """Return the log density of the prior for each row of ``x``.

        Args:
            theta: Parameters, shape ``(n, d)`` or ``(S, n, d)``. One row of theta
                serves all rows of ``x``.
            x: Observations, shape ``(n, *event)``; only their number matters.
            track_gradients: Whether gradients with respect to theta are needed.

        Returns:
            Shape ``(1, n)`` or ``(S, n)``, as in sbi.

        Raises:
            InvalidInputError: If the shapes do not fit.
        """
        theta = parameters_of(theta, self.prior.event_shape[0], batched=True)
        count = len(as_batch("x", x, finite=False))
        if theta.shape[-2] not in (1, count):
            raise InvalidInputError(
                f"Expected as many rows of `theta` as observations, {count}; got "
                f"{theta.shape[-2]}."
            )
        theta = theta if theta.ndim > 2 else theta.unsqueeze(0)
        theta = theta.expand(-1, count, -1)
        return self.potential_fn(theta, track_gradients=track_gradients)

    def map(self, *args: Any, **kwargs: Any) -> Tensor:
        """Return the mode of the prior, as in sbi.

        Raises:
            InvalidInputError: If sbi cannot transform the prior.
        """
        if self._reason_without_map:
            raise InvalidInputError(
                "Expected a prior that sbi can transform to an unbounded space; got "
                f"{type(self.prior).__name__} ({self._reason_without_map})."
            )
        return super().map(*args, **kwargs)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write this posterior to a file that :func:`sbi_rope.load` reads.

        No code is executed when the file is loaded.

        Args:
            path: The file. Its folder is made if there is none.
            overwrite: Whether to replace a file that exists.

        Raises:
            FileExistsError: If the file exists.
        """
        save(self, path, overwrite=overwrite)

    def to(self, device: str | torch.device) -> None:
        """Move the prior and the default x to a device."""
        self.potential_fn.to(device)
        default_x = self.default_x
        self.__init__(self.potential_fn.prior)
        if default_x is not None:
            self.set_default_x(default_x)


class _PriorPotential(BasePotential):
    """The log density of the prior, whatever x is."""

    prior: Distribution

    def __call__(self, theta: Tensor, track_gradients: bool = True) -> Tensor:  # noqa: FBT001, FBT002
        with torch.set_grad_enabled(track_gradients):
            return prior_log_prob(self.prior, theta)
