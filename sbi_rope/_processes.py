"""Worker processes that end when the process that started them ends."""

import multiprocessing
import os
import pickle
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor
from typing import Any

import joblib

__all__ = ["WORKER_ERRORS", "end_with", "in_workers"]

# What is raised if a worker dies, or if something cannot be sent to it.
WORKER_ERRORS = (BrokenExecutor, pickle.PicklingError)

# Seconds between two looks of a worker at its parent.
INTERVAL = 0.5
_watched: list[int] = []


def in_workers(
    function: Callable[..., Any],
    arguments: Iterable[tuple[Any, ...]],
    num_workers: int,
) -> Generator[Any, None, None]:
    """Call a function in several processes; yield what it returns, in order.

    In a worker there are no further workers.

    Args:
        function: What to call. With one worker it is called in this process.
        arguments: The arguments of each call.
        num_workers: The number of processes.
    """
    if _is_worker():
        num_workers = 1
    # A seeded block waits for those of other threads, so that threads do not do.
    options: dict[str, Any] = {"backend": "loky", "return_as": "generator"}
    run: Any = joblib.Parallel(n_jobs=num_workers, **options)
    parent = os.getpid()
    yield from run(joblib.delayed(_call)(parent, function, *each) for each in arguments)


def _call(parent: int, function: Callable[..., Any], *arguments: Any) -> Any:
    end_with(parent)
    return function(*arguments)


def end_with(parent: int) -> None:
    """End this process when its parent ends, in whatever way.

    Otherwise a worker whose parent was killed would finish its work, and might write
    files that another run is already using. Workers call this function. It has no
    effect in the parent itself, in workers that another process has started (such as
    those of a dask cluster), and on Windows.

    Linux can send a signal instead (PR_SET_PDEATHSIG), but it also sends it when only
    the thread that started the worker ends.

    Args:
        parent: The ID of the process that the worker works for.
    """
    # On Windows the ID of the parent does not change when the parent ends.
    if parent == os.getpid() or parent in _watched or os.name != "posix":
        return
    if os.getppid() == parent:
        _watched.append(parent)
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    elif _is_worker():
        # These workers are always children of the process they work for, so that it
        # must have ended already.
        os._exit(1)


def _is_worker() -> bool:
    return type(multiprocessing.current_process()).__name__ == "LokyProcess"


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(INTERVAL)
    os._exit(1)
