"""Seeds for a block of code, without effect on the random numbers after it."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral

import numpy as np
import torch

from sbi_rope.errors import InvalidInputError, shown

__all__ = ["seeded"]

# The generators belong to the process, not to a thread.
_LOCK = threading.RLock()


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Run a block with its own random numbers, or with the caller's if seed is None.

    sbi's estimators and most simulators draw from the global generators of torch, NumPy
    and Python, so that a generator object cannot be passed to them. The states of these
    generators are restored after the block.

    The seeded blocks of a process run one at a time: a thread that enters one waits
    until no other thread is in one. Blocks of one thread can be nested. A seeded block
    must not wait for another thread that enters one.

    Args:
        seed: A non-negative integer, or None.

    Raises:
        InvalidInputError: If the seed is something else.
    """
    if seed is None:
        yield
        return
    if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
        raise InvalidInputError(
            f"Expected `seed` to be a non-negative integer or None; got {shown(seed)}."
        )
    # The seed is changed to a large number. Otherwise seed 0 would draw the same
    # parameters as a user who has simulated after `torch.manual_seed(0)`.
    stream = (int(seed) * 0x9E3779B1 + 0x7F4A7C15) % 2**32
    with _LOCK:
        numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002
        has_mps = torch.backends.mps.is_available()
        mps_state = torch.mps.get_rng_state() if has_mps else None
        with torch.random.fork_rng(devices=list(range(torch.cuda.device_count()))):
            _seed_torch(stream)
            np.random.seed(stream)  # noqa: NPY002
            random.seed(stream)
            try:
                yield
            finally:
                np.random.set_state(numpy_state)  # noqa: NPY002
                random.setstate(python_state)
                if mps_state is not None:
                    torch.mps.set_rng_state(mps_state)


def _seed_torch(seed: int) -> None:
    # Without a device of its own, `torch.manual_seed` remembers for later where it was
    # called from. That takes milliseconds where calls are deep.
    if torch.cuda.is_available() or torch.backends.mps.is_available():
        torch.manual_seed(seed)
    else:
        torch.default_generator.manual_seed(seed)
