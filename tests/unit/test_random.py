"""Seeded blocks draw their own numbers and leave the caller's as they were."""

import random
import runpy
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np
import pytest
import torch

from sbi_rope import _random

# Seconds: a test that would hang fails instead.
LONG, SHORT = 20.0, 0.3


Seeded = Callable[[int | None], AbstractContextManager[None]]


@pytest.fixture
def seeded() -> Seeded:
    """Return a copy with a lock of its own: a thread left hanging holds up no other."""
    return runpy.run_path(_random.__file__)["seeded"]


def states() -> tuple[bytes, bytes, int]:
    numpy_state = np.random.get_state()[1]  # noqa: NPY002
    return (
        torch.get_rng_state().numpy().tobytes(),
        np.asarray(numpy_state).tobytes(),
        hash(random.getstate()),
    )


def draws() -> list[float]:
    return [
        float(torch.rand(())),
        float(np.random.uniform()),  # noqa: NPY002
        random.random(),
    ]


def test_blocks_of_two_threads_run_one_after_the_other_and_keep_the_state(
    seeded: Seeded,
) -> None:
    """The first block is left while the second thread is in its own, or waits."""
    before = states()
    with seeded(1):
        expected = draws()
    first_is_inside, second_is_inside = threading.Event(), threading.Event()
    first_has_left = threading.Event()
    drawn: dict[int, list[float]] = {}

    def first() -> None:
        with seeded(1):
            first_is_inside.set()
            # Without a lock it gets there, with one it cannot.
            second_is_inside.wait(SHORT)
            drawn[1] = draws()
        first_has_left.set()

    def second() -> None:
        first_is_inside.wait(LONG)
        with seeded(2):
            second_is_inside.set()
            first_has_left.wait(LONG)
            drawn[2] = draws()

    threads = [threading.Thread(target=f, daemon=True) for f in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
    assert not any(thread.is_alive() for thread in threads)
    assert states() == before
    assert drawn[1] == expected
    with seeded(2):
        assert drawn[2] == draws()


def test_blocks_of_one_thread_can_be_nested(seeded: Seeded) -> None:
    drawn: list[list[float]] = []

    def nested() -> None:
        with seeded(1):
            drawn.append(draws())
            with seeded(2):
                drawn.append(draws())
            drawn.append(draws())

    thread = threading.Thread(target=nested, daemon=True)
    thread.start()
    thread.join(LONG)
    assert not thread.is_alive()
    with seeded(1):
        assert [draws(), draws()] == [drawn[0], drawn[2]]
    with seeded(2):
        assert draws() == drawn[1]


def test_an_error_in_a_block_restores_the_state_and_frees_the_lock(
    seeded: Seeded,
) -> None:
    before = states()
    with pytest.raises(ZeroDivisionError), seeded(1):
        raise ZeroDivisionError
    assert states() == before

    def enter() -> None:
        with seeded(2):
            pass

    thread = threading.Thread(target=enter, daemon=True)
    thread.start()
    thread.join(LONG)
    assert not thread.is_alive()
