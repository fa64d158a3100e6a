"""Call a user's simulator: what it is given, and what is made of its answer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError, SimulationError, shown
from sbi_rope.tensors import as_array

__all__ = ["Caller", "Failure", "Form", "Simulated", "check_callable", "describe"]


@dataclass(frozen=True, kw_only=True)
class Form:
    """How a simulator is called.

    Attributes:
        batched: Whether it takes a batch ``(n, d)``, and not one theta ``(d,)``.
        arrays: Whether it takes NumPy arrays, and not tensors.
    """

    batched: bool
    arrays: bool

    def argument(self, theta: Tensor) -> Tensor | np.ndarray:
        """Return a copy of theta, because a simulator may change its argument.

        Arrays hold float64, as solvers of SciPy expect.
        """
        if self.arrays:
            return theta.detach().cpu().to(torch.float64, copy=True).numpy()
        return theta.clone()


@dataclass(frozen=True, eq=False, kw_only=True)
class Failure:
    """A row for which the simulator raised.

    Attributes:
        row: The number of the row.
        theta: Its parameters, as text.
        message: What was raised, in words.
        error: What was raised.
    """

    row: int
    theta: str
    message: str
    error: Exception

    @classmethod
    def of(cls, row: int, theta: Tensor, error: Exception) -> "Failure":
        """Return the failure of a row, of all theta ``(n, d)``."""
        return cls(
            row=row, theta=_as_text(theta[row]), message=describe(error), error=error
        )

    def moved_by(self, start: int) -> "Failure":
        """Return the failure, counted from rows that begin ``start`` rows earlier."""
        return replace(self, row=start + self.row)

    def __str__(self) -> str:
        return f"in row {self.row}, theta {self.theta}: {self.message}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulated:
    """Simulations of some rows.

    Attributes:
        x: Shape ``(n, *event)``, with NaN in the rows for which the simulator raised.
        num_calls: How many rows were simulated; a batch that raised counts too.
        num_failed: In how many rows the simulator raised.
        first: The first of these rows.
    """

    x: Tensor
    num_calls: int
    num_failed: int = 0
    first: Failure | None = None

    @classmethod
    def joined(cls, parts: Sequence["Simulated"]) -> "Simulated":
        """Return the simulations of all parts as one."""
        start, first = 0, None
        for part in parts:
            if first is None and part.first is not None:
                first = part.first.moved_by(start)
            start += len(part.x)
        return cls(
            x=torch.cat([part.x for part in parts]),
            num_calls=sum(part.num_calls for part in parts),
            num_failed=sum(part.num_failed for part in parts),
            first=first,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Caller:
    """A user's simulator, and what is known of it.

    Attributes:
        function: The simulator.
        form: How it is called.
        event_shape: Shape of one simulation.
        like: A tensor with the dtype and device that simulations get.
    """

    function: Callable[[Any], Any]
    form: Form
    event_shape: torch.Size
    like: Tensor

    def attempt(self, theta: Tensor) -> tuple[Tensor | None, Any]:
        """Call the simulator once.

        Args:
            theta: Parameters ``(n, d)``, or ``(d,)`` of a single simulation.

        Returns:
            A copy of the simulations ``(n, *event)`` or ``(*event)``, and what the
            simulator returned, or the error that it raised. There are no simulations if
            it raised, or if what it returned does not fit.
        """
        try:
            result = self.function(self.form.argument(theta))
        except Exception as error:  # any error of the user's code is a result here
            return None, error
        return self._fitted(result, theta.shape[:-1]), result

    def simulate(self, theta: Tensor) -> Simulated:
        """Simulate, theta ``(n, d)`` to x ``(n, *event)``.

        If a batch raises, its rows are simulated one by one.

        Raises:
            SimulationError: If what the simulator returns does not fit.
        """
        if not self.form.batched:
            return self._one_by_one(theta, theta.unbind())
        x, result = self.attempt(theta)
        if x is not None:
            return Simulated(x=x.to(self.like), num_calls=len(theta))
        if not isinstance(result, Exception):
            raise self._unfit(theta, result)
        rows = self._one_by_one(theta, theta.split(1))
        first = rows.first
        if rows.num_failed == len(theta):
            # It cannot take a single row either, and the batch tells more about that.
            first = Failure.of(0, theta, result)
        return replace(rows, num_calls=rows.num_calls + len(theta), first=first)

    def _one_by_one(self, theta: Tensor, pieces: Sequence[Tensor]) -> Simulated:
        """Simulate each piece, which is one theta or a batch of one."""
        missing = self.like.new_full((1, *self.event_shape), torch.nan)
        rows, num_failed, first = [], 0, None
        for number, piece in enumerate(pieces):
            x, result = self.attempt(piece)
            if x is not None:
                rows.append(x.reshape(1, *self.event_shape).to(self.like))
                continue
            if not isinstance(result, Exception):
                raise self._unfit(piece, result)
            rows.append(missing)
            num_failed += 1
            first = first or Failure.of(number, theta, result)
        return Simulated(
            x=torch.cat(rows), num_calls=len(rows), num_failed=num_failed, first=first
        )

    def _fitted(self, result: Any, leading: torch.Size) -> Tensor | None:
        """Return what fits as a tensor ``(*leading, *event)``."""
        x = _as_numbers(result)
        if x is None:
            return None
        shape = (*leading, *self.event_shape)
        shapes = {shape}
        if not leading:
            shapes.add((1, *self.event_shape))
        if leading == (1,):  # a simulator that squeezes leaves out the row, too
            shapes.add(tuple(self.event_shape))
        # One number, or one channel, without a dimension of its own.
        if self.event_shape[:1] == (1,):
            without = tuple(self.event_shape[1:])
            shapes.add((*leading, *without))
            if leading == (1,):
                shapes.add(without)
        return x.reshape(shape) if tuple(x.shape) in shapes else None

    def _unfit(self, theta: Tensor, result: Any) -> SimulationError:
        expected = (*theta.shape[:-1], *self.event_shape)
        where = f"shape {tuple(theta.shape)}"
        if theta.ndim == 1 or len(theta) == 1:
            where += f", which is {_as_text(theta)}"
        return SimulationError(
            f"Expected the simulator to return real numbers of shape {expected} for "
            f"theta of {where}; got {describe(result)}. Where a simulation cannot be "
            "made, return NaN of that shape."
        )


def check_callable(simulator: Any) -> None:
    """Raise unless a simulator can be called."""
    if not callable(simulator):
        raise InvalidInputError(
            "Expected `simulator` to be callable, from theta (n, d) to x (n, *event) "
            f"or from one theta (d,) to one x (*event); got {type(simulator).__name__}."
        )


def describe(result: Any) -> str:
    """Say in words what a simulator returned or raised."""
    if isinstance(result, Exception):
        return f"{type(result).__name__}: {result}"
    if isinstance(result, Tensor | np.ndarray):
        kind = "a tensor" if isinstance(result, Tensor) else "an array"
        special = "" if _holds_numbers(result) else " that does not hold plain numbers"
        shape, dtype = tuple(result.shape), result.dtype
        return f"{kind} of shape {shape} and dtype {dtype}{special}"
    if isinstance(result, list | tuple):
        return f"a {type(result).__name__} of length {len(result)}, {shown(result)}"
    return f"an object of type {type(result).__name__}"


def _as_numbers(result: Any) -> Tensor | None:
    """Return a copy of a result as a tensor of real numbers, or None."""
    if isinstance(result, list | tuple) and any(isinstance(v, Tensor) for v in result):
        try:
            result = torch.stack([torch.as_tensor(value) for value in result])
        except (TypeError, ValueError, RuntimeError):
            return None
    if isinstance(result, Tensor):
        return result.detach().clone() if _holds_numbers(result) else None
    try:
        array = as_array(result)
    except (TypeError, ValueError, RuntimeError):  # such as lists of unequal length
        return None
    return torch.from_numpy(array.astype(float)) if _holds_numbers(array) else None


def _holds_numbers(result: Tensor | np.ndarray) -> bool:
    """Tell whether a tensor or array holds plain real numbers."""
    if isinstance(result, np.ndarray):
        return result.dtype.kind in "biuf"
    special = result.is_nested or result.is_quantized or result.is_meta
    return result.layout == torch.strided and not special and not result.is_complex()


def _as_text(theta: Tensor) -> str:
    return shown(theta.detach().flatten().tolist())
