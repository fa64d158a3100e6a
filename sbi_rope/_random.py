"""Seeds that leave no trace."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["seeded"]


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Run a block with its own random numbers, or with the caller's if seed is None.

    sbi's estimators and most simulators draw from the global generators of torch and
    NumPy, so a generator object cannot be passed down. The states of both are put back
    afterwards.
    """
    if seed is None:
        yield
        return
    numpy_state = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices=list(range(torch.cuda.device_count()))):
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(numpy_state)  # noqa: NPY002
