"""Workers end when the process that started them ends, in whatever way."""

import multiprocessing
import os
import time
from multiprocessing.connection import Connection

import pytest

from sbi_rope._processes import end_with

fork = multiprocessing.get_context("fork")


def work(alive: Connection, parent: int) -> None:
    end_with(parent)
    end_with(parent)  # a worker gets many calls
    alive.send("at work")
    time.sleep(10)


def start_a_worker(alive: Connection, *, of_somebody_else: bool) -> None:
    parent = os.getppid() if of_somebody_else else os.getpid()
    fork.Process(target=work, args=(alive, parent)).start()
    time.sleep(10)


@pytest.mark.medium
@pytest.mark.parametrize("of_somebody_else", [False, True])
def test_a_worker_ends_with_the_parent_it_works_for(of_somebody_else: bool) -> None:
    reader, alive = fork.Pipe(duplex=False)
    parent = fork.Process(
        target=start_a_worker,
        args=(alive,),
        kwargs={"of_somebody_else": of_somebody_else},
    )
    parent.start()
    alive.close()
    assert reader.recv() == "at work"
    parent.kill()
    parent.join()
    # The pipe ends when nobody is left who could write to it.
    assert reader.poll(1.0 if of_somebody_else else 5.0) != of_somebody_else
    if not of_somebody_else:
        with pytest.raises(EOFError):
            reader.recv()


def test_the_function_has_no_effect_in_the_parent_itself() -> None:
    end_with(os.getpid())
