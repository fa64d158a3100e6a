r"""What a task is: a prior, a simulator, and labelled real observations."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._validation import check_batch, check_choice, check_integer
from sbi_rope.errors import InvalidInputError, InvalidTypeError
from sbi_rope.tasks.splits import MAX_SEED, Part

__all__ = ["Task", "check_theta"]

Simulator = Callable[[Tensor], Tensor]


class Task(ABC):
    r"""A benchmark of inference under a misspecified simulator.

    A task joins a prior :math:`p(\theta)`, a simulator :math:`x_s \sim S(\theta)`
    and labelled observations :math:`(\theta, x_o)` of a real process that the
    simulator describes only in part. The words are those of sbi.

    To write a task, subclass this class in a file of its own and

    1. set the class attributes ``name``, ``parameter_names``, ``parameter_units``
       (one string a parameter, ``"1"`` if it has no unit) and ``x_shape``, and
       ``variants`` if the real process comes in several kinds;
    2. implement :meth:`get_prior`: a new float32 distribution with event shape
       ``(theta_dim,)``, a ``support``, a ``mean`` and a ``variance``. Build tensors
       with an explicit dtype, so that torch's default does not matter;
    3. implement :meth:`get_simulator`: an instance of a class defined at the top of
       a module (so that it can be pickled) whose ``__call__`` passes its input
       through :func:`check_theta`, draws from torch's global generator, and keeps
       the dtype and device of ``theta``;
    4. implement :meth:`get_embedding_net`: a new, untrained network;
    5. implement :meth:`_labelled_set`. A synthetic real process passes its draw
       to :func:`~sbi_rope.tasks.splits.draw_rows`, recorded data go through
       :func:`~sbi_rope.tasks.splits.select_rows`. Both keep the two parts apart,
       leave all global random states alone, and make a small set the beginning of a
       larger one with the same seed;
    6. add the class to ``TASKS`` in ``sbi_rope/tasks/__init__.py``. The tests in
       ``tests/contract/test_task.py`` then apply to it.

    Options of a task are keyword arguments of its constructor, next to ``variant``
    and ``root``.

    Attributes:
        name: The name under which :func:`~sbi_rope.tasks.get_task` finds the task.
        parameter_names: One name a parameter, in the order of ``theta``.
        parameter_units: One unit a parameter.
        x_shape: Shape of one observation.
        variants: The kinds of real process besides the standard one.
        variant: The chosen kind, or ``None`` for the standard one.
        root: Folder with recorded data, or ``None``.

    Args:
        variant: One of ``variants``, or ``None`` for the standard real process.
        root: Folder that holds recorded data. Synthetic tasks do not read it, so
            that one ``root`` can be passed to all tasks.
    """

    name: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    parameter_units: ClassVar[tuple[str, ...]]
    x_shape: ClassVar[tuple[int, ...]]
    variants: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self, *, variant: str | None = None, root: str | Path | None = None
    ) -> None:
        if variant is not None:
            check_choice("variant", variant, self.variants)
        self.variant = variant
        self.root = None if root is None else Path(root).expanduser()

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

    @abstractmethod
    def get_prior(self) -> Distribution:
        """Return a new prior over theta, event shape ``(theta_dim,)``."""

    @abstractmethod
    def get_simulator(self) -> Simulator:
        """Return the simulator, from theta ``(n, theta_dim)`` to ``(n, *x_shape)``.

        It draws from torch's global generator, on the device of theta.
        """

    @abstractmethod
    def get_embedding_net(self) -> nn.Module:
        """Return a new network from x ``(n, *x_shape)`` to statistics ``(n, l)``."""

    def get_calibration_set(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Return ``n`` labelled real observations to calibrate with.

        Args:
            n: Number of observations.
            seed: Which set. With the same seed, a smaller set is the beginning of a
                larger one. No set shares an observation with any test set.

        Returns:
            Parameters of shape ``(n, theta_dim)`` and observations of shape
            ``(n, *x_shape)``, both float32.

        Raises:
            InvalidInputError: If ``n`` or ``seed`` is out of range, or recorded data
                have fewer than ``n`` observations to calibrate with.
            DataNotFoundError: If the task needs files that are not there.
        """
        return self._checked_set(n, seed=seed, part="calibration")

    def get_test_set(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Return ``n`` labelled real observations to test on.

        Arguments, result and errors are those of :meth:`get_calibration_set`.
        """
        return self._checked_set(n, seed=seed, part="test")

    def _checked_set(self, n: int, *, seed: int, part: Part) -> tuple[Tensor, Tensor]:
        check_integer("n", n)
        _check_seed(seed)
        return self._labelled_set(n, seed=seed, part=part)

    @abstractmethod
    def _labelled_set(self, n: int, *, seed: int, part: Part) -> tuple[Tensor, Tensor]:
        """Return ``n`` pairs of one part; ``n`` and ``seed`` have been checked."""

    def __repr__(self) -> str:
        variant = "" if self.variant is None else f"variant={self.variant!r}"
        return f"{type(self).__name__}({variant})"


def check_theta(theta: Any, theta_dim: int) -> Tensor:
    """Return ``theta`` if it is a batch of floating-point parameter vectors.

    Args:
        theta: What a simulator was called with.
        theta_dim: Number of parameters.

    Raises:
        InvalidTypeError: If ``theta`` is not a tensor of floating-point numbers.
        InvalidInputError: If its shape is not ``(n, theta_dim)``, or it is not finite.
    """
    theta = check_batch("theta", theta, (theta_dim,))
    if not theta.is_floating_point():
        raise InvalidTypeError(
            f"Expected `theta` to hold floating-point numbers; got {theta.dtype}. "
            "Convert it with `theta.float()`."
        )
    return theta


def _check_seed(seed: Any) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < MAX_SEED:
        raise InvalidInputError(
            f"Expected `seed` to be an integer from 0 to {MAX_SEED - 1}; got {seed!r}."
        )
