"""What is inside the posteriors of sbi, and posteriors made around an estimator."""

import copy
from typing import Any

import torch
from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from sbi.inference.posteriors.npe_a_posterior import NPE_A_Posterior
from sbi.inference.posteriors.vector_field_posterior import VectorFieldPosterior
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    ConditionalVectorFieldEstimator,
)
from sbi.utils.sbiutils import ImproperEmpirical
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi.embedding import device_of
from sbi_rope.errors import UnsupportedPosteriorError

__all__ = [
    "BaseDirectPosterior",
    "check_density",
    "describe",
    "direct_posterior",
    "estimator_of",
    "is_bounded",
    "posterior_from",
]


def estimator_of(posterior: Any) -> ConditionalEstimator:
    """Return the trained estimator inside an sbi posterior.

    Raises:
        UnsupportedPosteriorError: If the posterior is no plain amortised posterior of
            NPE, FMPE or NPSE, knows no prior or a truncated one, or has weights that
            are not finite.
    """
    prior = getattr(posterior, "prior", None)
    if isinstance(prior, ImproperEmpirical):
        raise UnsupportedPosteriorError(
            "Expected a posterior that knows its prior; got none. Use "
            "`npe.build_posterior(prior=prior)`."
        )
    # One that leaves out parameters whose simulations fail is no hindrance.
    accepts = getattr(getattr(prior, "_accept_reject_fn", None), "__qualname__", "")
    if accepts.startswith("get_density_thresholder."):
        raise UnsupportedPosteriorError(
            "Expected a posterior trained on the whole prior; got a prior truncated "
            "around one observation (TSNPE)."
        )
    if isinstance(posterior, VectorFieldPosterior):
        estimator: Any = posterior.vector_field_estimator
    else:
        estimator = getattr(posterior, "posterior_estimator", None)
        if (
            not isinstance(posterior, DirectPosterior)
            or isinstance(posterior, FilteredDirectPosterior | NPE_A_Posterior)
            or hasattr(estimator, "log_q")  # a density of this package
        ):
            raise UnsupportedPosteriorError(
                "Expected `posterior` to be what `NPE(...).build_posterior()` returns, "
                "or the posterior of MNPE, FMPE or NPSE; got "
                f"{type(posterior).__name__}."
            )
    for name, weights in estimator.named_parameters():
        if not torch.isfinite(weights).all():
            raise UnsupportedPosteriorError(
                f"Expected an NPE with finite weights; got NaN or Inf in `{name}`, so "
                "that its training has failed."
            )
    return estimator


def check_density(
    estimator: Any,
    *,
    what: str = "an estimator",
    because: str = "",
    instead: str = "Train NPE instead of FMPE or NPSE.",
) -> ConditionalDensityEstimator:
    """Return an estimator if it has a density.

    Args:
        estimator: What :func:`estimator_of` returns.
        what: What the message calls it.
        because: A clause of the message that says what needs a density.
        instead: The sentence of the message that says what to do next.

    Raises:
        UnsupportedPosteriorError: If it has none.
    """
    if not isinstance(estimator, ConditionalDensityEstimator):
        clause = f", because {because}" if because else ""
        raise UnsupportedPosteriorError(
            f"Expected {what} with a density, such as that of NPE{clause}; got "
            f"{type(estimator).__name__}. {instead}"
        )
    return estimator


def is_bounded(posterior: DirectPosterior) -> bool:
    """Tell whether a posterior normalises by other means than sbi's own rejection.

    That goes on until enough draws are inside the prior, which may be for ever.
    """
    # NPE_A_Posterior of sbi has a method of its own, but of the same kind.
    return type(posterior).leakage_correction.__module__.split(".")[0] != "sbi"


def posterior_from(
    posterior: Any, estimator: ConditionalEstimator
) -> DirectPosterior | VectorFieldPosterior:
    """Return an sbi posterior of the same kind as ``posterior`` around an estimator."""
    if not isinstance(estimator, ConditionalVectorFieldEstimator):
        assert isinstance(estimator, ConditionalDensityEstimator)
        return direct_posterior(
            estimator, posterior.prior, enable_transform=posterior.enable_transform
        )
    with seeded(0):  # sbi draws from the prior to look at it
        return VectorFieldPosterior(
            estimator,
            copy.deepcopy(posterior.prior),
            device=device_of(estimator),
            enable_transform=posterior.enable_transform,
            sample_with=posterior.sample_with,
        )


def direct_posterior(
    estimator: ConditionalDensityEstimator,
    prior: Distribution,
    *,
    enable_transform: bool = True,
) -> DirectPosterior:
    """Return an sbi posterior around an estimator and a copy of the prior."""
    with seeded(0):  # sbi draws from the prior to look at it
        return DirectPosterior(
            estimator,
            copy.deepcopy(prior),
            device=device_of(estimator),
            enable_transform=enable_transform,
        )


def describe(posterior: NeuralPosterior, purpose: str) -> None:
    """Set the sentence that ``str(posterior)`` ends with."""
    posterior._purpose = purpose


class BaseDirectPosterior(DirectPosterior):
    """sbi's DirectPosterior, for our own posteriors to derive from.

    ``map()`` shows the progress of its draws only if it was asked to, and never returns
    less than the best of its starting points. Shallow copies share no state. What
    checks an observation is :meth:`_one_x`: sbi itself refuses any NaN, which some
    embedding nets can read.
    """

    def _one_x(self, x: Any) -> Tensor:
        """Return a checked observation; the default x if it is None."""
        return super()._x_else_default_x(x)

    def _x_else_default_x(self, x: Any) -> Tensor:
        return self._one_x(x)

    def _keep_default_x(self, x: Tensor) -> None:
        """Set the default x to a copy of an observation that was checked."""
        self._x, self._map = x.clone().to(self._device), None

    def __getstate__(self) -> dict[str, Any]:
        # sbi hands out its own __dict__, which a shallow copy would then share.
        return dict(self.__dict__)

    def _calculate_map(  # type: ignore[override]
        self,
        *,
        init_method: str | Tensor = "posterior",
        num_init_samples: int,
        show_progress_bars: bool,
        **options: Any,
    ) -> Tensor:
        # sbi shows the progress of these draws whatever it was told.
        if isinstance(init_method, str) and init_method == "posterior":
            init_method = self.sample(
                (num_init_samples,), show_progress_bars=show_progress_bars
            )
        found = super()._calculate_map(
            init_method=init_method,
            num_init_samples=num_init_samples,
            show_progress_bars=show_progress_bars,
            **options,
        )
        if not isinstance(init_method, Tensor):
            return found
        # Where no step improves on the best start, sbi transforms that start a second
        # time and returns another point.
        heights = self.potential_fn(init_method)
        start = init_method[heights.argmax()].reshape(1, -1)
        improved = self.potential_fn(found.reshape(1, -1)) >= heights.max()
        return found.reshape(1, -1) if bool(improved) else start
