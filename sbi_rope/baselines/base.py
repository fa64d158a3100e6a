r"""What the baselines have in common: data goes in, a posterior of sbi comes out.

A method says which data it sees by the classes it derives from, each of which adds one
``append_*`` method. None of them takes labels of the observations to be inferred.
"""

import copy
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    DirectPosterior,
    copy_of_prior,
    device_of,
    direct_posterior,
    estimator_of,
    posterior_from,
)
from sbi_rope._training import History
from sbi_rope._validation import (
    check_batch,
    check_default_dtype,
    check_finite,
    check_gradients,
    check_in_support,
    check_instance,
    check_prior,
    check_same_length,
    check_tensor,
    check_values,
    usable_device,
)
from sbi_rope.baselines.training import (
    EstimatorBuilder,
    SimulationTrainer,
    Training,
    estimator_builder,
    train_with_sbi,
)
from sbi_rope.errors import InvalidInputError, NotReadyError, warn_user

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "BuildsOnNPE",
    "Method",
    "UsesCalibration",
    "UsesObservations",
    "UsesSimulations",
]


class Method(ABC):
    """A method of inference: construct, append data, ``train``, ``build_posterior``.

    What is passed in is copied or only read. Appending data after a training asks for
    another one, which starts anew.

    Args:
        prior: A torch distribution over parameters of shape ``(k,)``.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidTypeError: If the prior is not a torch distribution.
    """

    def __init__(self, prior: Any, *, device: str | torch.device = "cpu") -> None:
        check_prior(prior)
        check_default_dtype()
        self._prior: Distribution = copy_of_prior(prior)
        self._device = usable_device(device)
        if hasattr(self._prior, "to"):
            self._prior.to(self._device)  # type: ignore[attr-defined]
        elif self._device.type != "cpu":
            raise InvalidInputError(
                f"Cannot move the prior to {device}: a {type(prior).__name__} has no "
                "method `to`. Use a prior of sbi, such as BoxUniform."
            )
        self._event_shape: torch.Size | None = None
        self._posterior: Any = None
        self._history: History | None = None

    def train(
        self, *, seed: int | None = None, show_progress_bars: bool = True
    ) -> "Self":
        """Train on all data appended so far, from the start.

        Args:
            seed: Seed of everything random, for torch, NumPy and Python; None uses
                their states.
            show_progress_bars: Whether to show the course of the training.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            NotReadyError: If data that the method needs was not appended, or in
                torch's inference mode.
        """
        check_gradients()
        self._check_data()
        # Whatever the caller's own setting of gradients.
        with torch.enable_grad(), seeded(seed):
            self._posterior, self._history = self._fit(
                show_progress_bars=show_progress_bars
            )
        return self

    def build_posterior(self) -> Any:
        """Return a copy of the trained posterior, a posterior of sbi.

        Raises:
            NotReadyError: If ``train()`` was not called since data was appended.
        """
        if self._posterior is None:
            raise NotReadyError(
                f"{type(self).__name__} is not trained, or data was appended since. "
                "Call `train()` first."
            )
        return copy.deepcopy(self._posterior)

    @property
    def history(self) -> History:
        """The losses of the last training."""
        if self._history is None:
            raise NotReadyError(f"{type(self).__name__} has no losses to show.")
        return self._history

    @abstractmethod
    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        """Return the trained posterior and how it came about."""

    def _check_data(self) -> None:
        """Raise unless all data that is needed was appended."""
        return

    def _direct_posterior(
        self, estimator: ConditionalDensityEstimator
    ) -> DirectPosterior:
        return direct_posterior(estimator, self._prior)

    def _checked_x(self, name: str, x: Any, *, finite: bool = True) -> Tensor:
        x = check_tensor(name, x)
        if self._event_shape is None and x.ndim < 2:
            raise InvalidInputError(
                f"Expected `{name}` of shape (n, *event); got {tuple(x.shape)}."
            )
        shape = x.shape[1:] if self._event_shape is None else self._event_shape
        x = check_batch(name, x, shape, finite=False)
        check_values(name, x)
        x = x.detach().to(self._device, torch.float32, copy=True)
        if finite:
            check_finite(name, x)  # float32 may hold less
        return x

    def _checked_theta(self, name: str, theta: Any) -> Tensor:
        theta = check_batch(name, theta, self._prior.event_shape)
        theta = theta.detach().to(self._device, torch.float32, copy=True)
        check_finite(name, theta)
        return theta

    def _no_theta(self) -> Tensor:
        shape = (0, *self._prior.event_shape)
        return torch.empty(shape, dtype=torch.float32, device=self._device)

    def _append(self, old: Tensor | None, new: Tensor) -> Tensor:
        self._event_shape = new.shape[1:]
        self._posterior = self._history = None
        return new if old is None else torch.cat([old, new])

    def _needs(self, what: str, count: int, call: str) -> None:
        if not count:
            raise NotReadyError(
                f"{type(self).__name__} needs {what}. Call `{call}` first."
            )


class UsesSimulations(Method):
    """A method that sees simulations, pairs (theta, x) with theta from the prior."""

    def __init__(self, prior: Any, *, device: str | torch.device = "cpu") -> None:
        super().__init__(prior, device=device)
        self._theta = self._no_theta()
        self._x: Tensor | None = None

    def append_simulations(self, theta: Tensor, x: Tensor) -> "Self":
        """Add simulations; may be called repeatedly.

        Simulations with NaN or Inf are dropped with a warning.

        Args:
            theta: Parameters drawn from the prior, shape ``(n, k)``.
            x: Their simulations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidTypeError: If one of them is not a tensor.
            InvalidInputError: If shapes or row counts do not fit, or a theta is not in
                the support of the prior. Nothing is added then.
        """
        if self._ignores_simulations:
            warn_user(
                f"{type(self).__name__} starts from a trained posterior and makes no "
                "use of simulations."
            )
        theta = self._checked_theta("theta", theta)
        check_in_support("theta", theta, self._prior)
        x = self._checked_x("x", x, finite=False)
        check_same_length("theta", theta, "x", x)
        valid = torch.isfinite(x).flatten(1).all(dim=1)
        if not valid.any():
            raise InvalidInputError(
                "Expected simulations `x` that are finite; all contain NaN or Inf."
            )
        if not valid.all():
            warn_user(
                f"Dropped {int((~valid).sum())} of {len(x)} simulations because they "
                "contain NaN or Inf."
            )
        self._theta = torch.cat([self._theta, theta[valid]])
        self._x = self._append(self._x, x[valid])
        return self

    @property
    def _simulations(self) -> tuple[Tensor, Tensor]:
        assert self._x is not None
        return self._theta, self._x

    @property
    def needs_simulations(self) -> bool:
        """Whether simulations must be appended before the training."""
        return True

    @property
    def _ignores_simulations(self) -> bool:
        """Whether simulations that are appended have no effect."""
        return not self.needs_simulations

    def _check_data(self) -> None:
        super()._check_data()
        if self.needs_simulations:
            self._needs("simulations", len(self._theta), "append_simulations(theta, x)")


class UsesCalibration(Method):
    """A method that sees the calibration set, real observations with parameters."""

    def __init__(self, prior: Any, *, device: str | torch.device = "cpu") -> None:
        super().__init__(prior, device=device)
        self._theta_cal = self._no_theta()
        self._x_cal: Tensor | None = None

    def append_calibration(self, theta: Tensor, x: Tensor) -> "Self":
        """Add real observations with known parameters; may be called repeatedly.

        Args:
            theta: Parameters, shape ``(n, k)``, inside the prior's support.
            x: Real observations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidTypeError: If one of them is not a tensor.
            InvalidInputError: If shapes or row counts do not fit, a value is not
                finite, or a theta is outside the prior's support. Nothing is added
                then.
        """
        theta = self._checked_theta("theta", theta)
        check_in_support("theta", theta, self._prior)
        x = self._checked_x("x", x)
        check_same_length("theta", theta, "x", x)
        self._theta_cal = torch.cat([self._theta_cal, theta])
        self._x_cal = self._append(self._x_cal, x)
        return self

    @property
    def _calibration(self) -> tuple[Tensor, Tensor]:
        assert self._x_cal is not None
        return self._theta_cal, self._x_cal

    def _check_data(self) -> None:
        super()._check_data()
        self._needs(
            "calibration pairs", len(self._theta_cal), "append_calibration(theta, x)"
        )


class UsesObservations(Method):
    """A method that sees the observations to be inferred, without their parameters."""

    def __init__(self, prior: Any, *, device: str | torch.device = "cpu") -> None:
        super().__init__(prior, device=device)
        self._x_o: Tensor | None = None

    def append_observations(self, x_o: Tensor) -> "Self":
        """Add real observations without labels; may be called repeatedly.

        Args:
            x_o: Real observations, shape ``(n_o, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidTypeError: If it is not a tensor.
            InvalidInputError: If the shape does not fit, or a value is not finite.
        """
        self._x_o = self._append(self._x_o, self._checked_x("x_o", x_o))
        return self

    @property
    def _observations(self) -> Tensor:
        assert self._x_o is not None
        return self._x_o

    def _check_data(self) -> None:
        super()._check_data()
        count = 0 if self._x_o is None else len(self._x_o)
        self._needs("unlabelled observations", count, "append_observations(x_o)")


class BuildsOnNPE(UsesSimulations):
    """A method that starts from NPE, trained on the simulations or beforehand.

    Args:
        prior: A torch distribution over parameters of shape ``(k,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidTypeError: If an argument has the wrong type.
        InvalidInputError: If sbi knows no estimator of that name.
    """

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_instance("npe_training", npe_training, Training, optional=True)
        super().__init__(prior, device=device)
        self._build = estimator_builder(density_estimator)
        self._npe_training = Training() if npe_training is None else npe_training
        self._npe: Any = None

    @classmethod
    def from_posterior(cls, posterior: Any, **options: Any) -> "Self":
        """Start from a trained NPE instead of training one.

        Args:
            posterior: What ``NPE(...).build_posterior()`` of sbi returns. It is copied
                and never changed.
            **options: Keyword arguments of the constructor, except for ``device`` and
                what concerns the training of NPE.

        Returns:
            The method. If its ``needs_simulations`` is False, simulations that are
            appended have no effect, and earn a warning.

        Raises:
            UnsupportedPosteriorError: If it is not a plain amortised posterior.
            InvalidInputError: If an option would have no effect.
        """
        for name in ("density_estimator", "npe_training"):
            if name in options:
                raise InvalidInputError(
                    f"Expected no `{name}` beside a trained posterior; it would have "
                    "no effect."
                )
        estimator = estimator_of(posterior)
        method = cls(posterior.prior, device=device_of(estimator), **options)
        method._npe = posterior_from(posterior, copy.deepcopy(estimator))
        method._event_shape = estimator.condition_shape
        return method

    @property
    def needs_simulations(self) -> bool:
        """Whether there is something to train or to look up on simulations."""
        return self._npe is None

    def _trained_npe(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        if self._npe is not None:
            return self._npe, None
        theta, x = self._simulations
        estimator, history = train_with_sbi(
            SimulationTrainer,
            self._prior,
            self._build,
            theta,
            x,
            training=self._npe_training,
            show_progress_bars=show_progress_bars,
        )
        return self._direct_posterior(estimator), history
