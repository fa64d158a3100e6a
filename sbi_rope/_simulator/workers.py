"""Simulations in several worker processes."""

import os
import pickle
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import torch
from torch import Tensor

from sbi_rope._pickling import packed
from sbi_rope._processes import WORKER_ERRORS, in_workers
from sbi_rope._random import seeded
from sbi_rope._simulator.calls import (
    Caller,
    Simulated,
    check_callable,
    describe,
)
from sbi_rope.errors import SimulationError
from sbi_rope.settings import Range, check

__all__ = [
    "ParallelSimulator",
    "copy_in_worker",
    "parallel",
    "simulate_in_workers",
]

# A simulator of batches gets so many rows at a time in a worker.
ROWS = 100
REPAIR = (
    "Make what cannot be sent there, such as an open file, inside the simulator, and "
    "see whether the simulator works without `parallel`."
)


class ParallelSimulator:
    """A simulator that is called in worker processes, see :func:`parallel`.

    Called by itself, it is the simulator. Whoever knows this class distributes rows.

    Attributes:
        simulator: The simulator.
        num_workers: The number of worker processes.
    """

    def __init__(self, simulator: Callable[[Any], Any], num_workers: int) -> None:
        self.simulator = simulator
        self.num_workers = num_workers

    def __call__(self, theta: Any) -> Any:
        """Simulate in this process, exactly as the simulator does."""
        return self.simulator(theta)

    def __repr__(self) -> str:
        return f"parallel({self.simulator!r}, num_workers={self.num_workers})"


def parallel(
    simulator: Callable[[Any], Any], *, num_workers: int = 1
) -> ParallelSimulator:
    """Return a simulator whose rows are simulated in several processes at once.

    Pass what it returns as ``simulator`` to :class:`~sbi_rope.RoPE`, or to any method
    that takes a simulator. They hand each worker of joblib (loky) one theta at a time,
    or a hundred rows if the simulator takes batches. It pays if a call takes longer
    than about a millisecond.

    Every piece has a seed of its own. With the same seed the simulations therefore are
    the same for any ``num_workers``, but others than without ``parallel``. That holds
    for noise from the global generators of torch, NumPy and Python. A generator of the
    simulator itself has to be made inside of it, from a seed that one of these draws:
    ``rng = np.random.default_rng(np.random.randint(2**31))``.

    Args:
        simulator: As RoPE takes it, batched or not, of tensors or NumPy arrays. It may
            be a lambda.
        num_workers: The number of processes. With 1 everything is simulated in this
            one.

    Raises:
        InvalidInputError: If the simulator is not callable.
        InvalidInputError: If the number of workers is not a positive integer.

    Example:
        >>> import numpy as np
        >>> def simulator(theta):  # NumPy, and one theta at a time
        ...     return [np.sin(theta[0]), theta[1] ** 2]
        >>> parallel(simulator, num_workers=4).num_workers
        4
    """
    check_callable(simulator)
    check("num_workers", num_workers, Annotated[int, Range(1, 1000)])
    return ParallelSimulator(simulator, int(num_workers))


def copy_in_worker(simulator: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a simulator as it arrives in a worker process.

    Raises:
        SimulationError: If it cannot be sent there.
    """
    try:
        return pickle.loads(packed(simulator))
    except Exception as error:  # pickling runs code of the user
        raise SimulationError(
            "Expected a simulator that can be sent to worker processes; got "
            f"{describe(error)}. {REPAIR}"
        ) from error


def simulate_in_workers(
    caller: Caller,
    theta: Tensor,
    num_workers: int,
    *,
    advance: Callable[[int], object],
) -> Simulated:
    """Simulate, theta ``(n, d)`` to x ``(n, *event)``, in several processes.

    Args:
        caller: The simulator.
        theta: Parameters.
        num_workers: The number of processes.
        advance: Is told the number of rows whenever some are done.

    Raises:
        SimulationError: If the simulator cannot be sent to the workers, one of them
            dies, or what the simulator returns does not fit.
    """
    pieces = theta.split(ROWS if caller.form.batched else 1)
    seeds = torch.randint(2**31, (len(pieces),)).tolist()
    parent, simulated = os.getpid(), []
    arguments = (
        (parent, caller, piece, seed) for piece, seed in zip(pieces, seeds, strict=True)
    )
    try:
        for part in in_workers(_simulate_piece, arguments, num_workers):
            simulated.append(part)
            advance(len(part.x))
    except SimulationError as error:
        # Without the traceback of the worker, which says the same.
        raise SimulationError(*error.args) from None
    except WORKER_ERRORS as error:
        raise SimulationError(
            f"Expected a simulator that works in {num_workers} worker processes; got "
            f"{describe(error)}\n{REPAIR}"
        ) from error
    return Simulated.joined(simulated)


class _RaisedInWorkerError(Exception):
    """An error of a simulator with its traceback as text, which can be sent."""


def _simulate_piece(parent: int, caller: Caller, theta: Tensor, seed: int) -> Simulated:
    with seeded(seed):
        simulated = caller.simulate(theta)
    first = simulated.first
    if first is None or os.getpid() == parent:
        return simulated
    # Not every error can be pickled, and no traceback.
    text = "".join(traceback.format_exception(first.error))
    sent = replace(first, error=_RaisedInWorkerError(f"\n{text}"))
    return replace(simulated, first=sent)
