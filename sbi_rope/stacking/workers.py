"""Train the versions of a stack in several processes."""

import pickle
import traceback
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from typing import Any

import joblib
import torch

from sbi_rope._random import seeded
from sbi_rope.errors import InvalidInputError, RoPEError, RoPEWarning, warn_user
from sbi_rope.mixture import Part
from sbi_rope.stacking.candidates import AmortisedCandidate
from sbi_rope.stacking.checkpoints import Checkpoints
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.versions import train_version
from sbi_rope.stacking.workbench import Workbench

__all__ = ["check_sendable", "train_versions"]


def packed(thing: Any) -> bytes:
    """Return the pickle of anything, functions without a name of their own included."""
    return pickle.dumps(joblib.wrap_non_picklable_objects(thing, keep_wrapper=False))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Trained:
    """A version that was trained in another process, and what happened there.

    Attributes:
        densities: The densities of its candidates, by name.
        num_calls: How many simulations were made.
        num_dropped: How many of them were dropped.
        warned: Text, category, file and line of each warning.
    """

    densities: dict[str, list[Part]]
    num_calls: int
    num_dropped: int
    warned: tuple[tuple[str, type[Warning], str, int], ...]


def check_sendable(candidates: Sequence[AmortisedCandidate], bench: Workbench) -> None:
    """Raise unless candidates and all they share can be sent to other processes.

    Args:
        candidates: Those that are trained there.
        bench: What they share.

    Raises:
        InvalidInputError: If they cannot.
    """
    if not candidates:
        return
    try:
        pickle.loads(packed((candidates, bench)))
    except Exception as error:  # pickling runs code of the user
        raise InvalidInputError(
            "Expected a simulator, a prior and candidates that can be sent to other "
            f"processes; got {type(error).__name__}: {error}. Make what cannot be sent "
            "there, such as an open file, inside of the function that needs it, or "
            "leave `num_workers` at 1."
        ) from error


def train_versions(
    candidates: Sequence[AmortisedCandidate],
    folds: Sequence[Fold],
    *,
    num_workers: int,
    checkpoints: Checkpoints | None,
    advance: Callable[[int], object],
) -> tuple[dict[str, list[Part]], ...]:
    """Return the densities of one version for each of some folds.

    A fold has a seed of its own, so that its version does not depend on where it is
    trained. What all versions share is computed before, in this process.

    Args:
        candidates: Those that are trained in each version.
        folds: The pairs that each version may learn from, of the same workbench.
        num_workers: The number of processes.
        checkpoints: As in :func:`train_version`.
        advance: Is told how many candidates were trained, whenever some were.

    Raises:
        InvalidInputError: If a candidate returns no density. With several processes
            also if one of them dies, or a candidate raises there.
    """
    bench = folds[0].bench
    with seeded(bench.seed_of(frozenset())):
        for candidate in candidates:
            candidate.prepare(bench)
    num_workers = min(num_workers, len(folds))
    if num_workers == 1 or not candidates:
        return tuple(
            train_version(
                candidates, fold, checkpoints=checkpoints, advance=lambda: advance(1)
            )
            for fold in folds
        )
    # Each version gets a copy of its own, and gives its result back as a copy, also if
    # joblib decides to start no process.
    sent = packed((candidates, list(folds), checkpoints))
    tasks = ((sent, number, torch.get_num_threads()) for number in range(len(folds)))
    versions = []
    try:
        options: Any = {"backend": "loky", "return_as": "generator"}
        run: Any = joblib.Parallel(n_jobs=num_workers, **options)
        for version in run(joblib.delayed(_train_version)(*task) for task in tasks):
            versions.append(_unpacked(version, bench))
            advance(len(candidates))
    except (BrokenExecutor, pickle.PicklingError) as error:
        raise InvalidInputError(
            f"Expected candidates that can be trained in {num_workers} processes; got "
            f"{type(error).__name__}: {error}\nEach process has a copy of the "
            "simulations in its memory. If it was full, use fewer `num_workers`."
        ) from error
    return tuple(versions)


def _train_version(sent: bytes, number: int, num_threads: int) -> bytes:
    """Train a version in a worker.

    Args:
        sent: The candidates, all folds, and where densities are kept.
        number: The fold to train on.
        num_threads: The threads of torch that it may use at most.
    """
    torch.set_num_threads(min(torch.get_num_threads(), num_threads))
    candidates, folds, checkpoints = pickle.loads(sent)
    rope = folds[number].bench.rope
    calls, dropped = rope.num_simulator_calls, rope.num_dropped_simulations
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            densities = train_version(
                candidates, folds[number], checkpoints=checkpoints
            )
        warned = ((str(w.message), w.category, w.filename, w.lineno) for w in caught)
        return packed(
            _Trained(
                densities=densities,
                num_calls=rope.num_simulator_calls - calls,
                num_dropped=rope.num_dropped_simulations - dropped,
                warned=tuple(dict.fromkeys(warned)),
            )
        )
    except RoPEError:
        raise
    except Exception as error:  # not every error can be sent back
        raise InvalidInputError(
            "Expected candidates that can be trained in another process; got "
            f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
        ) from None


def _unpacked(version: bytes, bench: Workbench) -> dict[str, list[Part]]:
    """Do in this process what a worker would have done: count, and warn."""
    trained: _Trained = pickle.loads(version)
    source: Any = bench.rope.source
    source = getattr(source, "simulator", source)
    source.num_calls += trained.num_calls
    source.num_dropped += trained.num_dropped
    for text, category, filename, line in trained.warned:
        if issubclass(category, RoPEWarning):
            warn_user(text)
        else:
            warnings.warn_explicit(text, category, filename, line)
    return trained.densities
