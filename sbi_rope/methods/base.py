r"""What all methods have in common: data goes in, a posterior of sbi comes out."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import Self

from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import Source, source_of
from sbi_rope.methods.training import (
    EstimatorBuilder,
    estimator_builder,
    train_on_simulations,
)
from sbi_rope.npe.prior import PriorDistribution, check_in_support
from sbi_rope.npe.sbi import (
    TrainedNPE,
    direct_posterior,
    embedding_of,
    estimator_of,
    leave_out_constants,
    parameter_of,
    readable,
)
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import InvalidInputError, NotReadyError, warn_user
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import check
from sbi_rope.utils.tensors import as_batch, column_names, rows_with

Kind = Literal["simulations", "calibration", "observations"]
# The order in which a method asks for what it lacks.
KINDS: tuple[Kind, ...] = ("observations", "calibration", "simulations")


@dataclass
class Data:
    """What was appended, in float32: theta ``(n, d)`` and x ``(n, *event)``."""

    simulations: Any = ()
    calibration: Any = ()
    observations: Any = ()  # x alone

    @property
    def pairs(self) -> Pairs:
        """The calibration pairs, whose labels are exact."""
        return Pairs.exact(*self.calibration)


class Method(ABC):
    """A method of inference: construct, append data, ``train``, ``build_posterior``.

    What is passed in is copied or only read. Appending data after a training asks for
    another one, which starts anew. Of data that do not fit nothing is added.

    A subclass says which data it ``sees`` and returns a posterior from ``_fit``.

    Attributes:
        sees: The kinds of data that can be appended.
        starts_from_npe: Whether it starts from NPE, see ``from_posterior``.
        trains_on_statistics: Whether it trains on statistics of simulations, so that it
            needs simulations also beside a trained NPE.
        simulates: Whether it makes simulations of its own.
        min_pairs: The number of calibration pairs that it needs, if it sees them.
        default_training: How its own networks are trained; None if it has none.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        npe_training: How NPE is trained, for a method that starts from it;
            ``Training()`` if None.
        training: How the networks of the method itself are trained; its
            ``default_training`` if None.
        simulator: Maps parameters to simulations, batched or not, for a method that
            simulates. Without one, appended simulations take its place.
        device: Where to train; data on other devices is moved there.

    Raises:
        UnsupportedPosteriorError: In ``train``, if the method needs a density and the
            estimator has none.
    """

    sees: ClassVar[frozenset[Kind]]
    starts_from_npe: ClassVar[bool] = False
    trains_on_statistics: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    min_pairs: ClassVar[int] = 1
    default_training: ClassVar[Training | None] = None

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        npe_training: Training | None = None,
        *,
        training: Training | None = None,
        simulator: Callable[[Any], Any] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        for name, value, is_used in (
            ("npe_training", npe_training, self.starts_from_npe),
            ("training", training, self.default_training),
            ("simulator", simulator, self.simulates),
        ):
            if value is not None and not is_used:
                raise TypeError(f"{type(self).__name__} has no use for `{name}`.")
        check("npe_training", npe_training, Training | None)
        check("training", training, Training | None)
        self._prior = PriorDistribution(prior)
        self._device = torch.empty(0, device=device).device  # with its number
        self._prior.to(self._device)
        self._data = Data()
        self._event_shape: torch.Size | None = None
        self._embedding_net: nn.Module = nn.Identity()
        self._theta_names: tuple[str, ...] | None = None
        self._x_names: tuple[str, ...] | None = None
        self._simulator = simulator
        self._build = estimator_builder(density_estimator)
        self._npe_training = npe_training or Training()
        self.training: Any = training or self.default_training
        self._given_npe: Any = None
        self._posterior: Any = None
        self._history: History | None = None

    @classmethod
    def from_posterior(cls, posterior: Any, **options: Any) -> Self:
        """Start from a trained NPE instead of training one.

        Args:
            posterior: What ``NPE(...).build_posterior()`` returns, which is copied.
            **options: Keyword arguments of the constructor, except for ``device`` and
                what concerns the training of NPE.

        Raises:
            UnsupportedPosteriorError: If it is not a plain amortised posterior.
        """
        if not cls.starts_from_npe:
            raise InvalidInputError(
                f"Expected a method that starts from NPE; got {cls.__name__}. Call "
                f"`{cls.__name__}(prior)`."
            )
        estimator = estimator_of(posterior)
        method = cls(posterior.prior, device=parameter_of(estimator).device, **options)
        method._given_npe = TrainedNPE(posterior).posterior()
        method._event_shape = estimator.condition_shape
        method._theta_names = getattr(posterior, "parameter_names", None)
        method._x_names = getattr(posterior, "x_names", None)
        method._embedding_net = copy.deepcopy(embedding_of(estimator))
        return method

    def append_simulations(self, theta: Tensor, x: Tensor) -> Self:
        """Add simulations; may be called repeatedly.

        Those with NaN or Inf that the embedding net cannot read are dropped.

        Args:
            theta: Parameters drawn from the prior, shape ``(n, d)``.
            x: Their simulations, shape ``(n, *event)``.
        """
        return self._append("simulations", x, theta)

    def append_calibration(self, theta: Tensor, x: Tensor) -> Self:
        """Add real observations with known parameters; may be called repeatedly.

        Args:
            theta: Parameters, shape ``(n, d)``, inside the prior's support.
            x: Real observations, shape ``(n, *event)``.
        """
        return self._append("calibration", x, theta)

    def append_observations(self, x_o: Tensor) -> Self:
        """Add real observations without labels; may be called repeatedly.

        Args:
            x_o: Real observations, shape ``(n_o, *event)``.
        """
        return self._append("observations", x_o)

    def train(
        self, *, seed: int | None = None, show_progress_bars: bool | None = None
    ) -> Self:
        """Train on all data appended so far, from the start.

        Args:
            seed: Seed of everything random, for torch, NumPy and Python; None uses
                their states.
            show_progress_bars: Whether to show the course of the training. None does so
                in a terminal or a notebook, but not in a file.

        Raises:
            NotReadyError: If data that the method needs was not appended.
        """
        self._check_data()
        show = is_shown(show_progress_bars)
        # Whatever the caller's own setting of gradients.
        with torch.enable_grad(), seeded(seed):
            self._posterior, self._history = self._fit(show_progress_bars=show)
        return self

    def build_posterior(self) -> Any:
        """Return a copy of the trained posterior, a posterior of sbi."""
        if self._posterior is None:
            raise NotReadyError(
                f"{type(self).__name__} is not trained, or data was appended since. "
                "Call `train()` first."
            )
        posterior = copy.deepcopy(self._posterior)
        if hasattr(posterior, "x_names"):  # those of sbi read no tables
            posterior.parameter_names = self._theta_names
            posterior.x_names = self._x_names
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
        return "simulations" in self.sees and (used_anyway or self._given_npe is None)

    @abstractmethod
    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        """Return the trained posterior and its losses."""

    def _trained_npe(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        """Return the posterior of NPE, and its losses if it is trained now."""
        if self._given_npe is not None:
            return self._given_npe, None
        estimator, history = train_on_simulations(
            self._prior,
            self._build,
            *self._data.simulations,
            training=self._npe_training,
            show_progress_bars=show_progress_bars,
        )
        leave_out_constants(embedding_of(estimator))
        return direct_posterior(estimator, self._prior), history

    @property
    def _looked_up(self) -> tuple[Tensor, Tensor] | None:
        """The appended simulations, if there is no simulator to make others."""
        return self._data.simulations if self._simulator is None else None

    def _source(self) -> Source:
        """Return the simulator, or the appended simulations where there is none."""
        return source_of(
            self._prior,
            simulator=self._simulator,
            simulations=self._looked_up,
            like=torch.empty(0, *self._event_shape or (), device=self._device),
            readable=partial(readable, self._embedding_net),
        )

    def _append(self, kind: Kind, x: Any, theta: Any = None) -> Self:
        if kind not in self.sees:
            raise InvalidInputError(
                f"Expected a method that sees {kind}; got {type(self).__name__}."
            )
        new, name, rows, names = [], "x_o", None, self._x_names
        if kind != "observations":
            new, name, rows = [self._read_theta(theta)], "x", len(theta)
            check_in_support("theta", new[0], self._prior)
        read = as_batch(
            name, x, self._event_shape, rows=rows, names=names, finite=False
        )
        if read.ndim < 2:
            raise InvalidInputError(
                f"Expected `{name}` of shape (n, *event); got {tuple(read.shape)}. For "
                f"one number in each row pass `{name}[:, None]`."
            )
        new.append(read.to(self._device, torch.float32, copy=True))
        valid = readable(self._embedding_net, new[-1])
        if kind == "simulations" and valid.any() and not valid.all():
            warn_user(
                f"Dropped {int((~valid).sum())} of {len(valid)} simulations because "
                "they contain NaN or Inf."
            )
        elif not valid.all():
            raise InvalidInputError(
                f"Expected `{name}` to be finite; got NaN or Inf in "
                f"{rows_with(~valid)}."
            )
        new = tuple(one[valid] for one in new)
        if old := getattr(self._data, kind):
            new = tuple(map(torch.cat, zip(old, new, strict=True)))
        setattr(self._data, kind, new)
        self._event_shape = read.shape[1:]
        self._theta_names = self._theta_names or column_names(theta)
        self._x_names = self._x_names or column_names(x)
        self._posterior = self._history = None
        return self

    def _read_theta(self, theta: Any) -> Tensor:
        """Return a copy of parameters of a user, shape ``(n, d)``."""
        shape = self._prior.event_shape
        read = as_batch("theta", theta, shape, names=self._theta_names)
        return read.to(self._device, torch.float32, copy=True)

    def _check_data(self) -> None:
        """Raise unless there are all data that it needs."""
        for kind in KINDS:
            is_needed = self.needs_simulations if kind == "simulations" else True
            least = self.min_pairs if kind == "calibration" else 1
            count = len((getattr(self._data, kind) or [()])[0])
            if is_needed and kind in self.sees and count < least:
                raise NotReadyError(
                    f"{type(self).__name__} needs at least {least} rows of "
                    f"`append_{kind}(...)`; got {count}."
                )
