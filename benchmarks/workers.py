"""Calls in parallel, by processes that end with the one that started them."""

import os
from typing import Any

import joblib

from sbi_rope._processes import end_with

__all__ = ["parallel"]


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
    # Dask watches over its own workers, which may be on other machines.
    watch = {"initializer": end_with, "initargs": (os.getpid(),)}
    results = []
    # The way that knows external backends, dask's among them.
    with joblib.parallel_config(
        backend=backend, n_jobs=jobs, **(watch if backend == "loky" else {})
    ):
        run = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        for result in run(joblib.delayed(call[0])(*call[1:]) for call in calls):
            results.append(result)
            if bar is not None:
                bar.update(len(result))
    return results
