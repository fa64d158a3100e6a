"""All candidates of a stack, in a version for each fold."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.mixture import MixtureEstimator, Part
from sbi_rope.stacking.candidates import (
    AmortisedCandidate,
    Candidate,
    CouplingCandidate,
)
from sbi_rope.stacking.couplings import FittedCouplings
from sbi_rope.stacking.folds import Fold

__all__ = ["Versions", "train_version"]


def train_version(
    candidates: Sequence[Candidate], fold: Fold
) -> dict[Candidate, list[Part]]:
    """Train what depends on the pairs, on those of a fold; couplings excepted."""
    return {
        candidate: candidate.parts(fold)
        for candidate in candidates
        if isinstance(candidate, AmortisedCandidate) and not candidate.fixed
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class Versions:
    """Every candidate as it was trained without each fold of the pairs.

    A stack is deployed as it was scored: each candidate is the average of its versions,
    weighted by what held-out pairs say of them.

    Attributes:
        candidates: K of them.
        fixed: The densities of candidates that are the same in all versions.
        trained: For each version, the densities of the other amortised candidates.
        couplings: RoPE and OT-only in all versions; None without.
        tail_mass: As in :class:`~sbi_rope.mixture.MixtureEstimator`.
    """

    candidates: tuple[Candidate, ...]
    fixed: dict[Candidate, list[Part]]
    trained: tuple[dict[Candidate, list[Part]], ...]
    couplings: FittedCouplings | None = None
    tail_mass: float = 1e-3

    def estimator(
        self, weights: Tensor, numbers: Sequence[int] | None = None
    ) -> MixtureEstimator:
        """Return the mixture of some versions.

        Args:
            weights: Of the candidates, shape ``(K,)``; they sum to one.
            numbers: Of the versions, which count the same; all if None.
        """
        numbers = range(len(self.trained)) if numbers is None else numbers
        of_candidate = dict(zip(self.candidates, weights.tolist(), strict=True))
        parts: list[Part] = []
        shares: list[float] = []
        if self.couplings is not None:
            coupled, share = self.couplings.weighted(
                {
                    candidate: weight
                    for candidate, weight in of_candidate.items()
                    if isinstance(candidate, CouplingCandidate)
                },
                numbers,
            )
            parts.append(coupled)
            shares.append(share)
        for candidate, weight in of_candidate.items():
            if isinstance(candidate, CouplingCandidate):
                continue
            members = self.parts_of(candidate, numbers)
            parts += members
            shares += [weight / len(members)] * len(members)
        total = sum(shares)
        return MixtureEstimator(
            parts, [share / total for share in shares], tail_mass=self.tail_mass
        )

    def parts_of(self, candidate: Candidate, numbers: Sequence[int]) -> list[Part]:
        """Return the densities of a candidate in some versions."""
        if candidate in self.fixed:
            return self.fixed[candidate]
        return [part for number in numbers for part in self.trained[number][candidate]]

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
            numbers: Of the versions to average over; all if None.
            log_q: As in :meth:`FittedCouplings.log_probs`.

        Returns:
            Shape ``(n, K)``, float64, not corrected for leakage.
        """
        numbers = range(len(self.trained)) if numbers is None else numbers
        coupled = self._coupled_log_probs(theta, x, numbers, log_q)
        scores = []
        for candidate in self.candidates:
            if isinstance(candidate, CouplingCandidate):
                of_each = coupled[candidate]
            else:
                members = self.parts_of(candidate, numbers)
                equal = [1.0 / len(members)] * len(members)
                of_each = MixtureEstimator(members, equal).part_log_probs(theta, x)
            scores.append(log_mean_exp(of_each))
        return torch.stack(scores, dim=1)

    def _coupled_log_probs(
        self,
        theta: Tensor,
        x: Tensor,
        numbers: Sequence[int],
        log_q: Tensor | None,
    ) -> dict[CouplingCandidate, Tensor]:
        if self.couplings is None:
            return {}
        found: dict[CouplingCandidate, list[Tensor]] = {}
        of_each = self.couplings.log_probs(theta, x, log_q=log_q).unbind(dim=1)
        for (candidate, version), column in zip(
            self.couplings.settings, of_each, strict=True
        ):
            if version is None or version in numbers:
                found.setdefault(candidate, []).append(column)
        return {
            candidate: torch.stack(columns, dim=1)
            for candidate, columns in found.items()
        }


def log_mean_exp(log_probs: Tensor) -> Tensor:
    """Return the log of the mean density over the last dimension."""
    count = log_probs.shape[-1]
    return log_probs.logsumexp(dim=-1) - torch.tensor(float(count)).log().to(log_probs)
