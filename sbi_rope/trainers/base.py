r"""What all methods have in common: data goes in, a posterior of sbi comes out."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._progress import is_shown
from sbi_rope._random import seeded
from sbi_rope._sbi import device_of, embedding_of, estimator_of
from sbi_rope._simulations import SimulationSource
from sbi_rope._simulator import check_callable, source_of
from sbi_rope._training import History
from sbi_rope._validation import (
    check_default_dtype,
    check_prior,
    check_simulated_columns,
    columns_of,
    usable_device,
)
from sbi_rope.errors import InvalidInputError, NotReadyError, warn_user
from sbi_rope.trainers.data import Data, Kind
from sbi_rope.trainers.starting_npe import StartingNPE

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Method"]

# What data are called in messages, and the call that takes them.
DATA: dict[Kind, tuple[str, str]] = {
    "simulations": ("simulations", "append_simulations(theta, x)"),
    "calibration": ("calibration pairs", "append_calibration(theta, x)"),
    "observations": ("unlabelled observations", "append_observations(x_o)"),
}


class Method(ABC):
    """A method of inference: construct, append data, ``train``, ``build_posterior``.

    What is passed in is copied or only read. Appending data after a training asks for
    another one, which starts anew. No method takes the parameters of the observations
    to be inferred.

    A subclass says which data it ``sees`` and returns a posterior from ``_fit``.

    Attributes:
        sees: The kinds of data that can be appended.
        starts_from_npe: Whether it starts from NPE, so that :meth:`from_posterior` can
            take a trained one.
        trains_on_statistics: Whether it trains on statistics of simulations, so that it
            needs simulations also beside a trained NPE.
        simulates: Whether it makes simulations of its own. Without a simulator it looks
            them up among those that were appended.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        npe: The NPE to start from, of a method that does.
        simulator: Maps parameters to simulations, of a method that simulates.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If the prior is not a torch distribution, or the simulator
            cannot be called.
    """

    sees: ClassVar[frozenset[Kind]]
    starts_from_npe: ClassVar[bool] = False
    trains_on_statistics: ClassVar[bool] = False
    simulates: ClassVar[bool] = False

    def __init__(
        self,
        prior: Any,
        *,
        npe: StartingNPE | None = None,
        simulator: Callable[[Any], Any] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_prior(prior)
        check_default_dtype()
        self._prior: Distribution = copy.deepcopy(prior)
        self._device = usable_device(device)
        if hasattr(self._prior, "to"):
            self._prior.to(self._device)  # type: ignore[attr-defined]
        elif (of_prior := _device_of_draws(self._prior)) != self._device:
            raise InvalidInputError(
                f"Cannot move the prior from {of_prior} to {self._device}: a "
                f"{type(prior).__name__} has no method `to`. Use a prior of sbi, such "
                "as BoxUniform, or make the prior there."
            )
        self._data = Data(self._prior, self._device)
        self._npe = npe
        if simulator is not None:
            check_callable(simulator)
        self._simulator = simulator
        self._posterior: Any = None
        self._history: History | None = None

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
            InvalidInputError: If an option would have no effect, or the method does not
                start from NPE.
        """
        if not cls.starts_from_npe:
            raise InvalidInputError(
                f"Expected a method that starts from NPE; {cls.__name__} makes no use "
                f"of a trained posterior. Construct it with `{cls.__name__}(prior)`."
            )
        for name in ("density_estimator", "npe_training"):
            if name in options:
                raise InvalidInputError(
                    f"Expected no `{name}` beside a trained posterior; it would have "
                    "no effect."
                )
        estimator = estimator_of(posterior)
        method = cls(posterior.prior, device=device_of(estimator), **options)
        assert method._npe is not None
        method._npe.replace_by(posterior)
        method._data.event_shape = estimator.condition_shape
        method._data.columns = columns_of(posterior)
        method._data.embedding_net = copy.deepcopy(embedding_of(estimator))
        return method

    def append_simulations(self, theta: Tensor, x: Tensor) -> "Self":
        """Add simulations; may be called repeatedly.

        Simulations with NaN or Inf are dropped with a warning. NaN stays if it stands
        for a missing trial that the embedding net leaves out.

        Args:
            theta: Parameters drawn from the prior, shape ``(n, d)``.
            x: Their simulations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If one of them holds no numbers.
            InvalidInputError: If the method does not see simulations, shapes or row
                counts do not fit, a theta is not in the support of the prior, or the
                columns of a table are in another order than those of an earlier one.
                Nothing is added then.
        """
        self._check_seen("simulations")
        if self._ignores_simulations:
            warn_user(
                f"{type(self).__name__} starts from a trained posterior and makes no "
                "use of simulations."
            )
        self._data.append_simulations(theta, x)
        return self._untrained()

    def append_calibration(self, theta: Tensor, x: Tensor) -> "Self":
        """Add real observations with known parameters; may be called repeatedly.

        Args:
            theta: Parameters, shape ``(n, d)``, inside the prior's support.
            x: Real observations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If one of them holds no numbers.
            InvalidInputError: If the method does not see calibration pairs, shapes or
                row counts do not fit, a value is not finite, a theta is outside the
                prior's support, or the columns of a table are in another order than
                those of an earlier one. Nothing is added then.
        """
        self._check_seen("calibration")
        self._data.append_calibration(theta, x)
        return self._untrained()

    def append_observations(self, x_o: Tensor) -> "Self":
        """Add real observations without labels; may be called repeatedly.

        Args:
            x_o: Real observations, shape ``(n_o, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If it holds no numbers.
            InvalidInputError: If the method does not see observations, the shape does
                not fit, a value is not finite, or the columns of a table are in another
                order than those of an earlier one.
        """
        self._check_seen("observations")
        self._data.append_observations(x_o)
        return self._untrained()

    def train(
        self, *, seed: int | None = None, show_progress_bars: bool | None = None
    ) -> "Self":
        """Train on all data appended so far, from the start.

        Args:
            seed: Seed of everything random, for torch, NumPy and Python; None uses
                their states.
            show_progress_bars: Whether to show the course of the training. None does so
                in a terminal or a notebook, but not in a file.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            NotReadyError: If data that the method needs was not appended, or in
                torch's inference mode.
        """
        self._check_data()
        # Whatever the caller's own setting of gradients.
        with torch.enable_grad(), seeded(seed):
            self._posterior, self._history = self._fit(
                show_progress_bars=is_shown(show_progress_bars)
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
        posterior = copy.deepcopy(self._posterior)
        # Those of sbi do not look at it, but `evaluate` and `draw_samples` do.
        posterior.columns = dict(self._data.columns)
        return posterior

    @property
    def history(self) -> History:
        """The losses of the last training."""
        if self._history is None:
            raise NotReadyError(f"{type(self).__name__} has no losses to show.")
        return self._history

    @property
    def needs_simulations(self) -> bool:
        """Whether simulations must be appended, to train on or to look up."""
        looks_up = self.simulates and self._simulator is None
        used_anyway = looks_up or self.trains_on_statistics
        return "simulations" in self.sees and (used_anyway or not self._has_npe)

    @property
    def _ignores_simulations(self) -> bool:
        """Whether simulations that are appended have no effect."""
        return not self.needs_simulations

    @property
    def _has_npe(self) -> bool:
        """Whether it starts from an NPE that was trained beforehand."""
        return self._npe is not None and self._npe.is_given

    @abstractmethod
    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        """Return the trained posterior and how it came about."""

    def _trained_npe(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        """Return the posterior of the NPE to start from, and how that came about."""
        assert self._npe is not None
        return self._npe.posterior(
            self._prior, self._data, show_progress_bars=show_progress_bars
        )

    @property
    def _looked_up(self) -> tuple[Tensor, Tensor] | None:
        """The appended simulations, if there is no simulator to make others."""
        return self._data.simulations if self._simulator is None else None

    def _source(self) -> SimulationSource:
        """Return the simulator, or the appended simulations where there is none."""
        event_shape = self._data.event_shape
        assert event_shape is not None
        source = source_of(
            self._prior,
            simulator=self._simulator,
            simulations=self._looked_up,
            event_shape=event_shape,
            like=torch.empty(0, *self._prior.event_shape, device=self._device),
            readable=self._data.readable,
        )
        columns = self._data.columns
        columns["x"] = check_simulated_columns(source.x_columns, columns["x"])
        return source

    def _check_data(self) -> None:
        """Raise unless all data that is needed was appended."""
        for kind in reversed(DATA):
            if kind in self.sees and (kind != "simulations" or self.needs_simulations):
                self._check_some(kind)

    def _check_some(self, kind: Kind) -> None:
        what, call = DATA[kind]
        if not self._data.count(kind):
            raise NotReadyError(
                f"{type(self).__name__} needs {what}. Call `{call}` first."
            )

    def _check_seen(self, kind: Kind) -> None:
        if kind in self.sees:
            return
        what, call = DATA[kind]
        seen = [name for other, (name, _) in DATA.items() if other in self.sees]
        sees = f"only {' and '.join(seen)}" if seen else "no data"
        raise InvalidInputError(
            f"Expected a method that sees {what}; {type(self).__name__} sees "
            f"{sees}. Leave out `{call}`, or use another method."
        )

    def _untrained(self) -> "Self":
        self._posterior = self._history = None
        return self


def _device_of_draws(prior: Distribution) -> torch.device:
    with seeded(0):
        return prior.sample((1,)).device
