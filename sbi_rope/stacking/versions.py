"""All candidates of a stack, in one version for each fold."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import MixtureEstimator, Part
from sbi_rope.mixture.parts import DTYPE
from sbi_rope.stacking.candidates import AmortisedCandidate
from sbi_rope.stacking.checkpoints import Checkpoints
from sbi_rope.stacking.couplings import FittedCouplings
from sbi_rope.stacking.folds import Fold
from sbi_rope.tensors import as_batch, check_same_length

__all__ = ["Versions", "train_version"]


def train_version(
    candidates: Sequence[AmortisedCandidate],
    fold: Fold,
    *,
    checkpoints: Checkpoints | None = None,
    advance: Callable[[], object] = lambda: None,
) -> dict[str, list[Part]]:
    """Train candidates and return their densities by name.

    Args:
        candidates: The candidates.
        fold: The pairs to train on.
        checkpoints: Where densities are kept, and looked for before they are trained.
        advance: Called after each candidate, for a progress bar.

    Raises:
        InvalidInputError: If a candidate returns no density.
    """
    trained: dict[str, list[Part]] = {}
    for candidate in candidates:
        parts = None
        if checkpoints is not None:
            parts = checkpoints.trained(candidate, fold)
        if parts is None:
            parts = _trained(candidate, fold)
            if checkpoints is not None:
                checkpoints.keep(candidate, fold, parts)
        trained[candidate.name] = parts
        advance()
    return trained


def _trained(candidate: AmortisedCandidate, fold: Fold) -> list[Part]:
    # A candidate that ignores its seed still does not change the caller's random state.
    with seeded(fold.seed):
        parts = list(candidate.parts(fold))
    if not parts:
        raise InvalidInputError(
            f"Expected at least one density of {candidate.name!r}; got none."
        )
    return parts


@dataclass(frozen=True, eq=False, kw_only=True)
class Versions:
    """All candidates in all versions: trained without each fold, and on all pairs.

    A stack is made of the models that were scored: each candidate is the average of its
    versions, and the candidates are weighted by their held-out scores.

    Attributes:
        names: The names of the K candidates.
        fixed: The densities of the candidates that are the same in all versions.
        trained: For each version, the densities of the other amortised candidates.
        couplings: RoPE and OT-only in all versions; None if there is no batch.
        tail_mass: As in :class:`~sbi_rope.mixture.MixtureEstimator`.
    """

    names: tuple[str, ...]
    fixed: dict[str, list[Part]]
    trained: tuple[dict[str, list[Part]], ...]
    couplings: FittedCouplings | None = None
    tail_mass: float = 1e-3

    def estimator(
        self, weights: Tensor, numbers: Sequence[int] | None = None
    ) -> MixtureEstimator:
        """Return the mixture of some versions.

        Args:
            weights: The weights of the candidates, shape ``(K,)``; they sum to one.
            numbers: The numbers of the versions, which have equal weights; all if None.
        """
        numbers = range(len(self.trained)) if numbers is None else numbers
        of_name = dict(zip(self.names, weights.tolist(), strict=True))
        parts: list[Part] = []
        shares: list[float] = []
        if self.couplings is not None:
            coupled, share = self.couplings.weighted(of_name, numbers)
            parts.append(coupled)
            shares.append(share)
        for name in self.names:
            if self._is_coupled(name):
                continue
            members, equal = self.parts_of(name, numbers)
            parts += members
            shares += [of_name[name] * share for share in equal]
        total = sum(shares)
        return MixtureEstimator(
            parts, [share / total for share in shares], tail_mass=self.tail_mass
        )

    def _is_coupled(self, name: str) -> bool:
        return name not in self.fixed and name not in self.trained[0]

    def parts_of(
        self, name: str, numbers: Sequence[int]
    ) -> tuple[list[Part], list[float]]:
        """Return the densities of a candidate in some versions, and their shares.

        Versions have equal shares, and so have the densities within each version.
        Couplings are not among them.
        """
        if name in self.fixed:
            versions = [self.fixed[name]]
        else:
            versions = [self.trained[number][name] for number in numbers]
        shares = [1.0 / len(versions) / len(of_one) for of_one in versions]
        return (
            [part for of_one in versions for part in of_one],
            [
                share
                for share, of_one in zip(shares, versions, strict=True)
                for _ in of_one
            ],
        )

    @torch.no_grad()
    def log_probs(
        self,
        theta: Tensor,
        x: Tensor,
        numbers: Sequence[int] | None = None,
        *,
        log_q: Tensor | None = None,
    ) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.
            numbers: The numbers of the versions to average over; all if None.
            log_q: As in :meth:`FittedCouplings.log_probs`.

        Returns:
            Shape ``(n, K)``, float64, not corrected for leakage.

        Raises:
            InvalidInputError: If shapes do not fit or a value is not finite.
            UnseenObservationError: If there are couplings, an x is not in their batch,
                and ``unseen="raise"``.
        """
        numbers = range(len(self.trained)) if numbers is None else numbers
        theta = as_batch("theta", theta, self._any.density.input_shape).to(DTYPE)
        check_same_length("theta", theta, "x", x)
        scores = self._coupled_log_probs(theta, x, numbers, log_q)
        for name in self.names:
            if self._is_coupled(name):
                continue
            members, shares = self.parts_of(name, numbers)
            estimator = MixtureEstimator(members, shares)
            of_each = estimator.part_log_probs(theta, x)
            log_shares = estimator.weights.log()
            scores[name] = (of_each + log_shares).logsumexp(dim=1)
        return torch.stack([scores[name] for name in self.names], dim=1)

    @torch.no_grad()
    def node_log_probs(self, theta: Tensor, x: Tensor, number: int) -> Tensor:
        """Return the log density of each candidate at several parameters of each pair.

        Args:
            theta: S parameters of each pair, shape ``(n, S, d)``.
            x: The observations, shape ``(n, *event)``.
            number: The number of the version.

        Returns:
            Shape ``(n, S, K)``, float64, not corrected for leakage.
        """
        scores: dict[str, Tensor] = {}
        if self.couplings is not None:
            of_each = self.couplings.node_log_probs(theta, x).unbind(dim=2)
            settings = self.couplings.settings
            for (name, version), column in zip(settings, of_each, strict=True):
                if version is None or version == number:
                    scores[name] = column
        for name, estimator in self.estimators(number).items():
            scores[name] = estimator.log_prob(theta.movedim(1, 0), x).double().T
        return torch.stack([scores[name] for name in self.names], dim=2)

    def estimators(self, number: int) -> dict[str, MixtureEstimator]:
        """Return the density of each amortised candidate in one version, by name."""
        names = [name for name in self.names if not self._is_coupled(name)]
        return {
            name: MixtureEstimator(*self.parts_of(name, [number]), tail_mass=0.0)
            for name in names
        }

    @property
    def _any(self) -> Part:
        if self.couplings is not None:
            return self.couplings.part
        return self.parts_of(self.names[0], [0])[0][0]

    def _coupled_log_probs(
        self,
        theta: Tensor,
        x: Tensor,
        numbers: Sequence[int],
        log_q: Tensor | None,
    ) -> dict[str, Tensor]:
        if self.couplings is None:
            return {}
        found: dict[str, list[Tensor]] = {}
        of_each = self.couplings.log_probs(theta, x, log_q=log_q).unbind(dim=1)
        settings = self.couplings.settings
        for (name, version), column in zip(settings, of_each, strict=True):
            if version is None or version in numbers:
                found.setdefault(name, []).append(column)
        return {
            name: torch.stack(columns, dim=1).logsumexp(dim=1) - math.log(len(columns))
            for name, columns in found.items()
        }
