"""All candidates of a stack, in one version for each fold."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.mixture import MixtureEstimator, Part
from sbi_rope.mixture.parts import DTYPE

__all__ = ["Versions"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Versions:
    """All candidates in all versions: trained without each fold, and on all pairs.

    A stack is made of the models that were scored: each candidate is the average of its
    versions, and the candidates are weighted by their held-out scores.

    Attributes:
        names: The names of the K candidates.
        fixed: The densities of the candidates that are the same in all versions.
        trained: For each version, the densities of the other candidates.
    """

    names: tuple[str, ...]
    fixed: dict[str, list[Part]]
    trained: tuple[dict[str, list[Part]], ...]

    def estimator(
        self, weights: Tensor, numbers: Sequence[int] | None = None
    ) -> MixtureEstimator:
        """Return the mixture of some versions.

        Args:
            weights: The weights of the candidates, shape ``(K,)``; they sum to one.
            numbers: The numbers of the versions, which have equal weights; all if None.
        """
        parts: list[Part] = []
        shares: list[float] = []
        for name, weight in zip(self.names, weights.tolist(), strict=True):
            members, equal = self.parts_of(name, numbers)
            parts += members
            shares += [weight * share for share in equal]
        total = sum(shares)
        return MixtureEstimator(parts, [share / total for share in shares])

    def parts_of(
        self, name: str, numbers: Sequence[int] | None = None
    ) -> tuple[list[Part], list[float]]:
        """Return the densities of a candidate in some versions, and their shares.

        Versions have equal shares, and so have the densities within each version.
        """
        numbers = range(len(self.trained)) if numbers is None else numbers
        if name in self.fixed:
            versions = [self.fixed[name]]
        else:
            versions = [self.trained[number][name] for number in numbers]
        pairs = [
            (part, 1.0 / len(versions) / len(of_one))
            for of_one in versions
            for part in of_one
        ]
        return [part for part, _ in pairs], [share for _, share in pairs]

    @torch.no_grad()
    def log_probs(
        self, theta: Tensor, x: Tensor, numbers: Sequence[int] | None = None
    ) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.
            numbers: The numbers of the versions to average over; all if None.

        Returns:
            Shape ``(n, K)``, float64, not corrected for leakage.

        Raises:
            InvalidInputError: If shapes do not fit or a value is not finite.
        """
        scores = []
        for name in self.names:
            estimator = MixtureEstimator(*self.parts_of(name, numbers))
            of_each = estimator.part_log_probs(theta.to(DTYPE), x)
            scores.append((of_each + estimator.weights.log()).logsumexp(dim=1))
        return torch.stack(scores, dim=1)

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
        scores = [
            estimator.log_prob(theta.movedim(1, 0), x).double().T
            for estimator in self.estimators(number)
        ]
        return torch.stack(scores, dim=2)

    def estimators(self, number: int) -> list[MixtureEstimator]:
        """Return the density of each candidate in one version."""
        return [
            MixtureEstimator(*self.parts_of(name, [number]), tail_mass=0.0)
            for name in self.names
        ]
