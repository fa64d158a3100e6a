"""Seeds for a block of code, without effect on the random numbers after it."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from sbi_rope.utils.settings import Seed, check


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Run a block with its own random numbers, or with the caller's if seed is None.

    The global generators of torch, NumPy and Python, from which sbi and most simulators
    draw, get their states back after the block. It must not run in several threads.
    """
    check("seed", seed, Seed)
    if seed is None:
        yield
        return
    # The seed is changed to a large number. Otherwise seed 0 would draw the same
    # parameters as a user who has simulated after `torch.manual_seed(0)`.
    stream = (int(seed) * 0x9E3779B1 + 0x7F4A7C15) % 2**32
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002
    has_gpu = torch.cuda.is_available()
    with torch.random.fork_rng(devices=list(range(torch.cuda.device_count()))):
        # `torch.manual_seed` takes milliseconds where calls are deep.
        torch.default_generator.manual_seed(stream)
        if has_gpu:
            torch.cuda.manual_seed_all(stream)
        np.random.seed(stream)  # noqa: NPY002
        random.seed(stream)
        try:
            yield
        finally:
            np.random.set_state(numpy_state)  # noqa: NPY002
            random.setstate(python_state)
