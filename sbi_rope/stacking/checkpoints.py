"""Trained candidates in a folder, so that an interrupted stack can go on."""

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sbi_rope._files import set_aside
from sbi_rope._sbi import estimator_of
from sbi_rope._validation import check_path
from sbi_rope.errors import (
    FileFormatError,
    InvalidInputError,
    NotWritableError,
    warn_user,
)
from sbi_rope.mixture import MixtureEstimator, MixturePosterior, Part
from sbi_rope.saving import load, save
from sbi_rope.saving.description import Description
from sbi_rope.stacking.candidates import AmortisedCandidate, Candidate
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench

__all__ = ["Checkpoints"]

# Modules of which another version may train something else.
MODULES = ("sbi_rope", "sbi", "torch")
OF_ANOTHER_STACK = (
    "{folder} holds trained candidates of other stacks, and none of this one, so that "
    "all are trained. If you meant to go on with one of them, something differs: the "
    "seed, the pairs, NPE, a setting, or the simulations, which have to be the same "
    "for the same states of torch, NumPy and Python."
)


class Checkpoints:
    """A folder of trained candidates, with a folder inside for each stack.

    The name of the inner folder is a digest of what all candidates are trained on: NPE
    and its prior, the pairs, the simulations, the seeds and the settings. A stack of
    other pairs therefore finds another folder, and the same stack finds its own.

    Args:
        folder: The outer folder. It is made if there is none.
        candidates: The candidates.
        bench: What all folds share.
        seeds: The seeds of the stack.

    Raises:
        InvalidTypeError: If the folder is not a path.
        InvalidInputError: If NPE, its prior, or a resumable candidate cannot be
            described in a file.
        NotWritableError: If a folder cannot be made.
    """

    def __init__(
        self,
        folder: Any,
        candidates: Iterable[Candidate],
        bench: Workbench,
        seeds: Sequence[int],
    ) -> None:
        outer = check_path("checkpoints", folder)
        assert outer is not None
        self._prior = bench.npe.prior
        known = [
            Description(estimator_of(bench.npe), name="posterior_estimator"),
            Description(self._prior, name="prior"),
        ]
        # Their classes are in use already, so that files may name them.
        self._trusted = [value for one in known for value in one.named.values()]
        self._digests = {
            candidate.name: _of_candidate(candidate)
            for candidate in candidates
            if isinstance(candidate, AmortisedCandidate) and candidate.resumable
        }
        digest = _digest(
            [
                *map(_described, known),
                *(str(import_module(module).__version__) for module in MODULES),
                *(repr(part) for part in (seeds, len(bench.folds))),
                *(repr(part) for part in (bench.rope.finetuner, bench.labels.names)),
                *_tensors(bench),
            ]
        )
        self._folder = outer / f"stack-{digest[:16]}"
        others = list(outer.glob("stack-*"))
        if others and self._folder not in others:
            warn_user(OF_ANOTHER_STACK.format(folder=outer))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise NotWritableError(
                "Expected `checkpoints` to be a folder, or a path where one can be "
                f"made; got {outer} ({error.strerror or error}). Use another path."
            ) from error

    def trained(self, candidate: AmortisedCandidate, fold: Fold) -> list[Part] | None:
        """Return the densities that a candidate was trained to; None if it was not."""
        if candidate.name not in self._digests:
            return None
        path = self._path(candidate, fold)
        if not path.is_file():
            return None
        try:
            posterior = load(path, trusted=self._trusted)
        except FileFormatError as error:
            other = set_aside(path)
            warn_user(
                f"{candidate.name!r} is trained again, because its checkpoint cannot "
                f"be used. {error} It is called {other} now, and can be removed."
            )
            return None
        device = fold.bench.x.device
        return [part.to(device) for part in posterior.posterior_estimator.parts]

    def keep(
        self, candidate: AmortisedCandidate, fold: Fold, parts: Sequence[Part]
    ) -> None:
        """Write the densities of a candidate to the folder."""
        if candidate.name not in self._digests:
            return
        shares = [1.0 / len(parts)] * len(parts)
        posterior = MixturePosterior(MixtureEstimator(parts, shares), self._prior)
        try:
            save(posterior, self._path(candidate, fold), overwrite=True)
        except NotWritableError as error:
            # What was trained is worth more than its copy.
            warn_user(
                f"The checkpoint of {candidate.name!r} was not written. The stack goes "
                f"on without it. {error}"
            )

    def _path(self, candidate: AmortisedCandidate, fold: Fold) -> Path:
        used = "-".join(str(number) for number in sorted(fold.used))
        digest = self._digests[candidate.name]
        name = re.sub(r"[^A-Za-z0-9]+", "_", candidate.name).strip("_")[:60]
        return self._folder / f"{name}-folds_{used}-{digest[:16]}.pt"


def _of_candidate(candidate: AmortisedCandidate) -> str:
    try:
        return _described(Description(candidate, name=candidate.name))
    except InvalidInputError as error:
        raise InvalidInputError(
            f"Expected `resumable` of {candidate.name!r} to be False, because its "
            f"attributes cannot be described. {error}"
        ) from error


def _tensors(bench: Workbench) -> list[Tensor | None]:
    labels, (theta, x) = bench.labels, bench.simulations
    of_pairs = (labels.theta, labels.covariance, labels.weights, labels.samples)
    return [*of_pairs, bench.groups, bench.x, theta, x, bench.embedded]


def _described(described: Description) -> str:
    return _digest([json.dumps(described.objects), *described.tensors])


def _digest(contents: Iterable[str | Tensor | None]) -> str:
    """Return a digest of texts and tensors, in this order."""
    digest = hashlib.blake2b(digest_size=32)
    for content in contents:
        if isinstance(content, Tensor):
            digest.update(f"{content.dtype} {tuple(content.shape)};".encode())
            flat = content.detach().cpu().contiguous().flatten()
            digest.update(flat.view(torch.uint8).numpy().data)
        else:
            digest.update(f"{content};".encode())
    return digest.hexdigest()
