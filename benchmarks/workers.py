"""Calls in parallel, by processes that end with the one that started them."""

import os
import threading
import time
from collections.abc import Callable
from typing import Any

import joblib

__all__ = ["parallel"]

# Backends of joblib whose workers are children of this process on the same machine;
# those of dask watch over their own.
CHILDREN = ("loky", "multiprocessing")
# How often a worker looks for its parent, in seconds.
INTERVAL = 0.5
_watched: list[int] = []


def parallel(
    jobs: int, backend: str, calls: list[tuple[Any, ...]], bar: Any = None
) -> list[Any]:
    """Return the results of calls, in the order in which they end.

    Args:
        jobs: Calls at a time.
        backend: Name of a backend of joblib.
        calls: Functions, each with its arguments.
        bar: A progress bar that counts what the results hold.
    """
    parent = os.getpid() if backend in CHILDREN else None
    results = []
    # The way that knows external backends, dask's among them.
    with joblib.parallel_config(backend=backend, n_jobs=jobs):
        run = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        for result in run(joblib.delayed(_call)(parent, *call) for call in calls):
            results.append(result)
            if bar is not None:
                bar.update(len(result))
    return results


def _call(parent: int | None, function: Callable[..., Any], *arguments: Any) -> Any:
    if parent is not None:
        _end_with(parent)
    return function(*arguments)


def _end_with(parent: int) -> None:
    """Let this process end when its parent does, however that ends.

    A worker whose parent was killed would go on with what it was given, and write to a
    folder that another run may have taken over. Linux could send a signal instead
    (PR_SET_PDEATHSIG), but does so too when the thread that started the worker ends.
    """
    # Windows has no orphans: a process keeps the number of its first parent for ever.
    if parent == os.getpid() or parent in _watched or os.name != "posix":
        return
    _watched.append(parent)
    # Before the first call, for it may have ended while this process was starting.
    _end_if_orphaned(parent)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while True:
        time.sleep(INTERVAL)
        _end_if_orphaned(parent)


def _end_if_orphaned(parent: int) -> None:
    if os.getppid() != parent:
        os._exit(1)
