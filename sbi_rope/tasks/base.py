r"""The base class of all tasks: a prior, a simulator and labelled observations."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.tasks.chambers import where
from sbi_rope.tasks.settings import PaperSettings
from sbi_rope.tasks.splits import MAX_SEED, DrawnPairs, Keep, Part, RecordedPairs
from sbi_rope.tasks.variants import (
    COMMON_VARIANTS,
    beta_shaped,
    inside_region,
    with_label_noise,
)
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import Count, Range, UnitInterval, check, one_of

Simulator = Callable[[Tensor], Tensor]

LABEL_NOISE = 0.2


class Task(ABC):
    r"""A benchmark of inference under a misspecified simulator.

    A task joins a prior :math:`p(\theta)`, a simulator :math:`x_s \sim S(\theta)`
    and labelled observations :math:`(\theta, x_o)` of a real process that the
    simulator describes only in part. The words are those of sbi.

    To write a task, subclass this class in a file of its own and

    1. set the class attributes listed below; those of one instance, such as a shape
       that an option changes, may be set by the constructor;
    2. implement :meth:`get_prior`: a new float32 distribution with event shape
       ``(theta_dim,)``, a ``support``, a ``mean`` and a ``variance``. Build tensors
       with an explicit dtype, so that torch's default does not matter. Implement
       :meth:`prior_quantiles` too, unless it is a box;
    3. implement :meth:`get_simulator`: an instance of a class defined at the top of
       a module (so that it can be pickled) whose ``__call__`` passes its input
       through ``as_batch``, draws from torch's global generator, and keeps the dtype
       and device of ``theta``;
    4. implement :meth:`get_embedding_net`: a new, untrained network;
    5. implement ``_real_process``: the pairs of the real process, drawn or
       recorded. The variants common to all tasks need nothing else;
    6. add the class to ``TASKS`` in ``sbi_rope/tasks/__init__.py``. The tests in
       ``tests/contract/test_task*.py`` then apply to it.

    Options of a task are keyword arguments of its constructor, next to ``variant``,
    ``root`` and ``label_noise``.

    Attributes:
        name: The name under which :func:`~sbi_rope.tasks.get_task` finds the task.
        parameter_names: One name a parameter, in the order of ``theta``.
        parameter_units: One unit a parameter, ``"1"`` if it has none.
        x_shape: Shape of one observation.
        x_names: One name an entry if an observation is a list of statistics; empty
            for series and images.
        z_score_x: How sbi's ``posterior_nn`` should standardise x: ``"independent"``
            for every entry, ``"structured"`` for all entries together, ``"none"``.
        misspecification: In a sentence, what the simulator gets wrong.
        variants: The kinds of real process besides the standard one, with a sentence
            each. ``COMMON_VARIANTS`` belong to all tasks.
        shifted_region: The intervals that parameters come from in the variant
            ``"prior_shift"``.
        paper_settings: The hyper-parameters the paper states, ``None`` for tasks that
            are not in it.
        stand_in: Whether a model stands in for recorded observations.
        variant: The chosen kind, or ``None`` for the standard one.
        root: Folder with recorded data, or ``None``.
        label_noise: Standard deviation of the noise on calibration labels, as a
            fraction of the prior's; 0 except in the variant ``"noisy_labels"``.

    Args:
        variant: One of ``variants``, or ``None`` for the standard real process.
        root: Folder that holds recorded data. Synthetic tasks do not read it, so
            that one ``root`` can be passed to all tasks.
        label_noise: From 0 to 1, and only for ``"noisy_labels"``; 0.2 unless given.
    """

    name: ClassVar[str]
    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    x_shape: tuple[int, ...]
    x_names: tuple[str, ...] = ()
    z_score_x: ClassVar[Literal["independent", "structured", "none"]] = "independent"
    misspecification: ClassVar[str]
    variants: ClassVar[dict[str, str]] = COMMON_VARIANTS
    shifted_region: ClassVar[dict[str, tuple[float, float]]]
    paper_settings: ClassVar[PaperSettings | None] = None
    stand_in: bool = False

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
    ) -> None:
        if variant is not None:
            check("variant", variant, one_of(list(self.variants)))
        self.variant = variant
        self.root = None if root is None else Path(root).expanduser()
        self.label_noise = self._strength(
            "label_noise", label_noise, LABEL_NOISE, variant="noisy_labels"
        )

    @property
    def theta_dim(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    @property
    def prior_std(self) -> Tensor:
        """The prior's standard deviation, shape ``(theta_dim,)``, in natural units.

        Dividing theta by it makes scores comparable between tasks.
        """
        return self.get_prior().stddev

    @property
    def required_files(self) -> tuple[Path, ...]:
        """Recorded files below ``root`` that the sets are read from.

        There are none for sets that are drawn.
        """
        if self.variant == "well_specified":
            return ()
        return self._recorded_files()

    @property
    def has_data(self) -> bool:
        """Whether the two labelled sets can be had without a download."""
        files = self.required_files
        if not files:
            return True
        return all(where(file, self.root) is not None for file in files)

    @abstractmethod
    def get_prior(self) -> Distribution:
        """Return a new prior over theta, event shape ``(theta_dim,)``."""

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        """Return the prior's marginal distribution functions at theta ``(n, d)``.

        Of a box, these are relative positions. Tasks with other priors override it.
        """
        prior: Any = self.get_prior()
        return prior.base_dist.cdf(theta)

    @abstractmethod
    def get_simulator(self) -> Simulator:
        """Return the simulator, from theta ``(n, d)`` to x ``(n, *x_shape)``.

        It draws from torch's global generator.
        """

    @abstractmethod
    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return a new network from x ``(n, *x_shape)`` to statistics ``(n, l)``.

        Args:
            light: Whether to return a small network for a CPU instead of the paper's.
        """

    @abstractmethod
    def _real_process(self, part: Part) -> DrawnPairs | RecordedPairs:
        """Return the labelled pairs of the real process for one part."""

    def _recorded_files(self) -> tuple[Path, ...]:
        """Return the files behind ``_real_process``, relative to ``root``."""
        return ()

    def get_calibration_set(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Return ``n`` labelled real observations to calibrate with.

        Args:
            n: Number of observations.
            seed: Number of the set. With the same seed, a smaller set is the beginning
                of a larger one. No set shares an observation with any test set.

        Returns:
            Parameters of shape ``(n, d)`` and observations of shape
            ``(n, *x_shape)``, both float32.

        Raises:
            InvalidInputError: If ``n`` or ``seed`` is out of range, or recorded data
                have fewer than ``n`` observations to calibrate with.
            DataNotFoundError: If the task needs files that are not there.
        """
        theta, x = self._take(n, seed=seed, part="calibration")
        if self.variant == "noisy_labels":
            with torch.device("cpu"):
                std = self.label_noise * self.prior_std
                theta = with_label_noise(theta, std, self.get_prior(), seed=int(seed))
        return theta, x

    def get_test_set(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Return ``n`` labelled real observations to test on.

        Arguments, result and errors are those of :meth:`get_calibration_set`.
        """
        return self._take(n, seed=seed, part="test")

    def get_simulations(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Return ``n`` draws of the prior and a simulation of each, to train on.

        Simulations with NaN are replaced together with their parameters, and counted
        in a warning. Arguments and result are those of :meth:`get_calibration_set`;
        no parameter is shared with the two sets.
        """
        return self._take(n, seed=seed, part="simulation")

    def _simulated_process(self) -> DrawnPairs:
        """Return the pairs to train on."""
        prior = self.get_prior()
        return DrawnPairs(
            draw_theta=lambda n: prior.sample((n,)),  # type: ignore[arg-type]
            observe=self.get_simulator(),
        )

    def _well_specified_process(self, part: Part) -> DrawnPairs | RecordedPairs:
        return self._simulated_process()

    def num_recorded(self, part: Part, *, seed: int = 0) -> int | None:
        """Return how many pairs a set can have, or None if any number can be drawn.

        Args:
            part: ``"calibration"`` or ``"test"``.
            seed: Seed of the set. Variants keep other pairs under other seeds.
        """
        with torch.device("cpu"):
            process = self._process_of(part)
            if isinstance(process, DrawnPairs):
                return None
            return len(process.rows_kept(seed=seed, part=part, keep=self._keep(part)))

    def _take(self, n: int, *, seed: int, part: Part) -> tuple[Tensor, Tensor]:
        check("n", n, Count)
        check("seed", seed, Annotated[int, Range(0, MAX_SEED - 1)])
        # Every machine has the same sets. Integers of NumPy would overflow in streams.
        with torch.device("cpu"):
            process = self._process_of(part)
            return process.take(
                int(n), seed=int(seed), part=part, keep=self._keep(part)
            )

    def _process_of(self, part: Part) -> DrawnPairs | RecordedPairs:
        if part == "simulation":
            return self._simulated_process()
        if self.variant == "well_specified":
            return self._well_specified_process(part)
        return self._real_process(part)

    def _keep(self, part: Part) -> Keep | None:
        """Return which parameters of the real process a part may have."""
        if self.variant == "prior_shift" and part != "simulation":
            names, region = self.parameter_names, self.shifted_region
            return lambda theta: inside_region(theta, names, region)
        if self.variant == "biased_calibration" and part == "calibration":
            return lambda theta: beta_shaped(self.prior_quantiles(theta))
        return None

    def _strength(
        self, name: str, value: float | None, default: float, *, variant: str
    ) -> float:
        """Return the strength of a variant, from 0 to 1; 0 in all others."""
        check(name, value, UnitInterval | None)
        if self.variant != variant:
            if value is not None:
                raise InvalidInputError(
                    f"Expected `{name}` with `variant={variant!r}` only; got "
                    f"`variant={self.variant!r}`."
                )
            return 0.0
        return default if value is None else value

    def __repr__(self) -> str:
        options = [] if self.variant is None else [f"variant={self.variant!r}"]
        if self.stand_in and self.variant != "synthetic":
            options.append("stand_in=True")
        return f"{type(self).__name__}({', '.join(options)})"
