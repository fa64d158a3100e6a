"""Processes that end with the one that started them."""

import multiprocessing
import os
import threading
import time

__all__ = ["end_with"]

# How often a worker looks for its parent, in seconds.
INTERVAL = 0.5
_watched: list[int] = []


def end_with(parent: int) -> None:
    """Let this process end when its parent does, however that ends.

    A worker whose parent was killed would go on with what it was given, and write where
    another run may be at work by then. To be called by workers; without effect in the
    parent itself, in workers that were started by others, such as those of a dask
    cluster, and on Windows.

    Linux could send a signal instead (PR_SET_PDEATHSIG), but does so too when only the
    thread that started the worker ends.

    Args:
        parent: Number of the process that the worker works for.
    """
    # On Windows a process keeps the number of its first parent for ever.
    if parent == os.getpid() or parent in _watched or os.name != "posix":
        return
    if os.getppid() == parent:
        _watched.append(parent)
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    elif type(multiprocessing.current_process()).__name__ == "LokyProcess":
        # Always a child of the process it works for, which ended while this started.
        os._exit(1)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(INTERVAL)
    os._exit(1)
