"""Train the versions of a stack in several processes."""

import pickle
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import joblib

from sbi_rope._processes import WORKER_ERRORS, in_workers
from sbi_rope.errors import InvalidInputError, RoPEWarning, warn_user
from sbi_rope.mixture import Part
from sbi_rope.stacking.candidates import AmortisedCandidate, Candidate
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.versions import train_version
from sbi_rope.stacking.workbench import Workbench

__all__ = ["check_sendable", "train_versions"]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Trained:
    """A version that was trained in another process, and what happened there.

    Attributes:
        densities: The densities of its candidates, by name.
        num_calls: How many simulations were made.
        num_dropped: How many of them were dropped.
        warned: Text and category of each warning.
    """

    densities: dict[str, list[Part]]
    num_calls: int
    num_dropped: int
    warned: tuple[tuple[str, type[Warning]], ...]


def check_sendable(candidates: Sequence[Candidate], bench: Workbench) -> None:
    """Raise unless candidates and all they share can be sent to other processes.

    Raises:
        InvalidInputError: If they cannot.
    """
    try:
        pickle.dumps(joblib.wrap_non_picklable_objects([_trained(candidates), bench]))
    except Exception as error:  # pickling runs code of the user
        raise InvalidInputError(
            "Expected a simulator, a prior and candidates that can be sent to other "
            f"processes; got {type(error).__name__}: {error}. Make what cannot be sent "
            "there, such as an open file, inside of the function that needs it, or "
            "leave `num_workers` at 1."
        ) from error


def train_versions(
    candidates: Sequence[Candidate],
    folds: Sequence[Fold],
    *,
    num_workers: int,
    advance: Callable[[int], object],
) -> tuple[dict[str, list[Part]], ...]:
    """Return the densities of one version for each of some folds.

    A fold has a seed of its own, so that its version does not depend on where it is
    trained. What all versions share is computed before, in this process.

    Args:
        candidates: All candidates; the amortised ones that depend on the pairs are
            trained.
        folds: The pairs that each version may learn from, of the same workbench.
        num_workers: The number of processes.
        advance: Is told how many candidates were trained, whenever some were.

    Raises:
        InvalidInputError: If a candidate returns no density, or if a process dies.
    """
    bench, trained = folds[0].bench, _trained(candidates)
    for candidate in trained:
        candidate.prepare(bench)
    if num_workers == 1 or len(folds) == 1 or not trained:
        return tuple(
            train_version(trained, fold, advance=lambda: advance(1)) for fold in folds
        )
    versions: list[dict[str, list[Part]]] = []
    try:
        for version in in_workers(
            _train_version,
            ((trained, fold) for fold in folds),
            min(num_workers, len(folds)),
        ):
            versions.append(_received(version, bench))
            advance(len(trained))
    except WORKER_ERRORS as error:
        raise InvalidInputError(
            f"Expected candidates that can be trained in {num_workers} processes; got "
            f"{type(error).__name__}: {error}\nEach process has a copy of the "
            "simulations in its memory. Use fewer `num_workers`."
        ) from error
    return tuple(versions)


def _trained(candidates: Sequence[Candidate]) -> list[AmortisedCandidate]:
    """Return the candidates that are trained anew in each version."""
    return [
        candidate
        for candidate in candidates
        if isinstance(candidate, AmortisedCandidate) and not candidate.fixed
    ]


def _train_version(candidates: Sequence[Candidate], fold: Fold) -> _Trained:
    """Train a version in a worker."""
    rope = fold.bench.rope
    calls, dropped = rope.num_simulator_calls, rope.num_dropped_simulations
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        densities = train_version(candidates, fold)
    return _Trained(
        densities=densities,
        num_calls=rope.num_simulator_calls - calls,
        num_dropped=rope.num_dropped_simulations - dropped,
        warned=tuple((str(one.message), one.category) for one in caught),
    )


def _received(version: _Trained, bench: Workbench) -> dict[str, list[Part]]:
    """Do in this process what a worker would have done: count, and warn."""
    bench.rope.source.count(version.num_calls, version.num_dropped)
    for text, category in version.warned:
        if issubclass(category, RoPEWarning):
            warn_user(text)
        else:
            warnings.warn(text, category, stacklevel=2)
    return version.densities
