"""Trained candidates in a folder, so that an interrupted stack can go on."""

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from sbi_rope._files import set_aside
from sbi_rope._random import seeded
from sbi_rope._sbi import embed, estimator_of
from sbi_rope.errors import (
    DataNotFoundError,
    FileFormatError,
    InvalidInputError,
    NotWritableError,
    UntrustedError,
    warn_user,
)
from sbi_rope.mixture import MixtureEstimator, Part
from sbi_rope.saving.description import Description
from sbi_rope.saving.files import read_object, versions_of, write_object
from sbi_rope.stacking.candidates import AmortisedCandidate, Candidate
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.trained_candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
)
from sbi_rope.stacking.unlabelled_candidates import RVNPCandidate
from sbi_rope.stacking.workbench import Workbench

__all__ = ["Checkpoints"]

# Of these it is known what they are trained on. Their subclasses are not among them.
KEPT = (DiscrepancyCandidate, FinetunedCandidate, RehearsedCandidate, RVNPCandidate)
# Another version of this package may train something else, also if it has the same
# number.
OURS = Path(__file__).parents[1]
# Draws of the prior, by which it is recognised.
NUM_FROM_PRIOR = 1000
OF_OTHER_STACKS = (
    "{folder} holds trained candidates of other stacks, and none of this one, so that "
    "all are trained. If you meant to go on with one of them, something differs: the "
    "seed, the pairs, NPE, a setting, a package, the simulations, which have to be the "
    "same for the same states of torch, NumPy and Python, or the rounding, because of "
    "another processor, device or number of threads."
)


class Checkpoints:
    """A folder of trained candidates: those of one stack, or of several.

    The name of a file holds a digest of all that its candidate was trained on, so that
    a stack finds its own files, and those of no other one.

    Args:
        folder: The folder. It is made if there is none.
        candidates: The candidates.
        bench: What all folds share.
        seeds: The seeds of the stack.

    Raises:
        InvalidInputError: If NPE cannot be described in a file.
        NotWritableError: If the folder cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        candidates: Iterable[Candidate],
        bench: Workbench,
        seeds: Sequence[int],
    ) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise NotWritableError(
                "Expected `checkpoints` to be a folder, or a path where one can be "
                f"made; got {folder} ({error.strerror or error}). Use another path."
            ) from error
        self._folder = folder
        npe = _description_of_npe(bench)
        # Its classes are in use already, so that a file may name them.
        self._trusted = dict(npe.named)
        self._warns = True
        context = [
            *_described(npe),
            versions_of(npe.packages),
            *_of_all(bench, seeds),
        ]
        pairs = _of_pairs(bench)
        self._digests = {
            candidate.name: _digest(
                [
                    *context,
                    *([] if candidate.fixed else pairs),
                    *_of_candidate(candidate, bench),
                ]
            )
            for candidate in candidates
            if isinstance(candidate, AmortisedCandidate) and type(candidate) in KEPT
        }
        names = [path.name for path in folder.glob("*.pt")]
        digests = self._digests.values()
        if names and not any(one in name for name in names for one in digests):
            warn_user(OF_OTHER_STACKS.format(folder=folder))

    def trained(self, candidate: AmortisedCandidate, fold: Fold) -> list[Part] | None:
        """Return the densities that a candidate was trained to; None if it was not."""
        if candidate.name not in self._digests:
            return None
        path = self._path(candidate, fold)
        if not path.is_file():
            return None
        try:
            estimator = read_object(path, self._trusted, MixtureEstimator)
        except DataNotFoundError:  # another process has put it aside
            return None
        except (FileFormatError, UntrustedError):
            warn_user(
                f"{candidate.name!r} is trained again, because its checkpoint {path} "
                f"is damaged.{_put_aside(path)}"
            )
            return None
        device = fold.bench.x.device
        return [part.to(device) for part in estimator.parts]

    def keep(
        self, candidate: AmortisedCandidate, fold: Fold, parts: Sequence[Part]
    ) -> None:
        """Write the densities of a candidate to the folder."""
        if candidate.name not in self._digests:
            return
        shares = [1.0 / len(parts)] * len(parts)
        try:
            write_object(MixtureEstimator(parts, shares), self._path(candidate, fold))
        except NotWritableError as error:
            # What was trained is worth more than its copy.
            if self._warns:
                warn_user(
                    f"The checkpoint of {candidate.name!r} was not written. The stack "
                    "goes on, and does not say so again if another one cannot be "
                    f"written. {error}"
                )
            self._warns = False

    def _path(self, candidate: AmortisedCandidate, fold: Fold) -> Path:
        name = re.sub(r"[^A-Za-z0-9]+", "_", candidate.name).strip("_")
        used = _digest([sorted(fold.used)])
        return self._folder / f"{name}-{self._digests[candidate.name]}-{used}.pt"


def _description_of_npe(bench: Workbench) -> Description:
    try:
        return Description(estimator_of(bench.npe), name="posterior_estimator")
    except InvalidInputError as error:
        raise InvalidInputError(
            "Expected an NPE that can be described in a file, because there are "
            f"`checkpoints`. {error} Or leave `checkpoints` out."
        ) from error


def _of_all(bench: Workbench, seeds: Sequence[int]) -> list[object]:
    """Return what all candidates depend on, apart from NPE."""
    # Priors of torch keep what was asked of them, and are recognised by their draws.
    with seeded(0):
        theta = bench.npe.prior.sample(torch.Size((NUM_FROM_PRIOR,)))
    return [
        *(path.read_bytes() for path in sorted(OURS.rglob("*.py"))),
        bench.x.device.type,
        list(seeds),
        theta,
        bench.npe.prior.log_prob(theta),
    ]


def _of_pairs(bench: Workbench) -> list[object]:
    """Return what candidates depend on that learn from the pairs."""
    labels = bench.labels
    return [
        len(bench.folds),
        *(labels.theta, labels.covariance, labels.weights, labels.samples),
        bench.rope.labelled_parameters.draws,
        bench.groups,
        bench.x,
        # The code of a net may have changed, and its weights not.
        embed(bench.embedding_net, bench.x),
    ]


def _of_candidate(candidate: AmortisedCandidate, bench: Workbench) -> list[object]:
    """Return the settings of a candidate, and what it knows of the simulator."""
    contents: list[object] = [repr(candidate)]
    if isinstance(candidate, RVNPCandidate):
        contents.append(candidate.x_o)
    elif isinstance(candidate, DiscrepancyCandidate | FinetunedCandidate):
        if candidate.space is None:
            return contents
        moments = bench.moments(candidate.space)
        contents += [moments.mean, moments.covariance, moments.possible]
    return [*contents, *bench.simulations]


def _described(described: Description) -> list[object]:
    # Sets of names, which have another order in each process, are sorted there.
    return [json.dumps(described.objects), *described.tensors]


def _digest(contents: Iterable[object]) -> str:
    """Return a digest of tensors, and of values that are told apart by their repr."""
    digest = hashlib.blake2b(digest_size=10)
    for content in contents:
        if isinstance(content, Tensor):
            digest.update(f"{content.dtype} {tuple(content.shape)};".encode())
            flat = content.detach().cpu().contiguous().flatten()
            digest.update(flat.view(torch.uint8).numpy().data)
        else:
            digest.update(f"{content!r};".encode())
    return digest.hexdigest()


def _put_aside(path: Path) -> str:
    """Rename a file that cannot be used, and say what became of it."""
    try:
        other = set_aside(path)
    except OSError:  # nothing can be renamed there
        return ""
    return "" if other is None else f" It is called {other} now, and can be removed."
