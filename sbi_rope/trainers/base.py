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
from sbi_rope.errors import InvalidInputError, NotReadyError
from sbi_rope.fit import History
from sbi_rope.settings import check
from sbi_rope.simulate import Source, source_of
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
    another one, which starts anew.

    A subclass says which data it ``sees`` and returns a posterior from ``_fit``.

    Attributes:
        sees: The kinds of data that can be appended.
        starts_from_npe: Whether it starts from NPE, so that :meth:`from_posterior` can
            take a trained one.
        trains_on_statistics: Whether it trains on statistics of simulations, so that it
            needs simulations also beside a trained NPE.
        simulates: Whether it makes simulations of its own. Without a simulator it looks
            them up among those that were appended.
        min_pairs: The number of calibration pairs that it needs, if it sees them.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        npe: The NPE to start from, of a method that does.
        simulator: Maps parameters to simulations, of a method that simulates.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If the prior is no torch distribution over vectors.
    """

    sees: ClassVar[frozenset[Kind]]
    starts_from_npe: ClassVar[bool] = False
    trains_on_statistics: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    min_pairs: ClassVar[int] = 1

    def __init__(
        self,
        prior: Any,
        *,
        npe: StartingNPE | None = None,
        simulator: Callable[[Any], Any] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("prior", prior, Distribution)
        if len(prior.event_shape) != 1:
            raise InvalidInputError(
                "Expected `prior` over vectors, with event shape (d,); got event shape "
                f"{tuple(prior.event_shape)}."
            )
        self._prior: Distribution = copy.deepcopy(prior)
        self._device = torch.empty(0, device=device).device  # with its number
        if hasattr(self._prior, "to"):
            self._prior.to(self._device)  # type: ignore[attr-defined]
        self._data = Data(self._prior, self._device)
        self._npe = npe
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
            appended have no effect.

        Raises:
            UnsupportedPosteriorError: If it is not a plain amortised posterior.
            InvalidInputError: If the method does not start from NPE.
        """
        if not cls.starts_from_npe:
            raise InvalidInputError(
                f"Expected a method that starts from NPE; got {cls.__name__}. Call "
                f"`{cls.__name__}(prior)`."
            )
        estimator = estimator_of(posterior)
        method = cls(posterior.prior, device=device_of(estimator), **options)
        assert method._npe is not None
        method._npe.replace_by(posterior)
        method._data.event_shape = estimator.condition_shape
        method._data.theta_names = getattr(posterior, "parameter_names", None)
        method._data.x_names = getattr(posterior, "x_names", None)
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
            InvalidInputError: If the method does not see simulations, shapes do not
                fit, or a theta is outside the prior's support. Nothing is added then.
        """
        return self._append("simulations", theta, x)

    def append_calibration(self, theta: Tensor, x: Tensor) -> "Self":
        """Add real observations with known parameters; may be called repeatedly.

        Args:
            theta: Parameters, shape ``(n, d)``, inside the prior's support.
            x: Real observations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If the method does not see calibration pairs, shapes do
                not fit, a value is not finite, or a theta is outside the prior's
                support. Nothing is added then.
        """
        return self._append("calibration", theta, x)

    def append_observations(self, x_o: Tensor) -> "Self":
        """Add real observations without labels; may be called repeatedly.

        Args:
            x_o: Real observations, shape ``(n_o, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If the method does not see observations, the shape does
                not fit, or a value is not finite.
        """
        return self._append("observations", x_o)

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
            NotReadyError: If data that the method needs was not appended.
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
        if hasattr(posterior, "x_names"):  # those of sbi read no tables
            posterior.parameter_names = self._data.theta_names
            posterior.x_names = self._data.x_names
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

    def _source(self) -> Source:
        """Return the simulator, or the appended simulations where there is none."""
        event_shape = self._data.event_shape
        assert event_shape is not None
        return source_of(
            self._prior,
            simulator=self._simulator,
            simulations=self._looked_up,
            event_shape=event_shape,
            like=torch.empty(0, *self._prior.event_shape, device=self._device),
            readable=self._data.readable,
        )

    def _append(self, kind: Kind, *data: Any) -> "Self":
        if kind not in self.sees:
            seen = [DATA[one][0] for one in DATA if one in self.sees]
            raise InvalidInputError(
                f"Expected a method that sees {DATA[kind][0]}; {type(self).__name__} "
                f"sees {'only ' + ' and '.join(seen) if seen else 'no data'}."
            )
        getattr(self._data, f"append_{kind}")(*data)
        self._posterior = self._history = None
        return self

    def _check_data(self, *kinds: Kind) -> None:
        """Raise unless there are the data of these kinds, or of all, that it needs."""
        for kind in kinds or tuple(reversed(DATA)):
            what, call = DATA[kind]
            is_needed = kind != "simulations" or self.needs_simulations
            least = self.min_pairs if kind == "calibration" else 1
            if not is_needed or kind not in self.sees:
                continue
            if (count := self._data.count(kind)) < least:
                raise NotReadyError(
                    f"{type(self).__name__} needs at least {least} {what}; got "
                    f"{count}. Call `{call}` first."
                )
