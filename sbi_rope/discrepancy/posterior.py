"""The posterior of gain, offset and error, and draws from it."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.distributions import Chi2

from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.tensors import as_batch

# Entries of the matrices that simulations are corrected by at a time.
MAX_ENTRIES = 2**22
# The smallest noise of an entry, relative to the largest, that is told apart from none.
SMALLEST_SCALE = 0.01
# The smallest standard deviations of noise and error, in those of simulations from the
# prior, times D. Some statistics have no noise. x can be more precise than h(x).
SMALLEST_NOISE = 0.01
SMALLEST_ERROR = {"embedding": 0.01, "tuned": 0.01, "input": 0.003}


def noise_scale(covariance: Tensor) -> Tensor:
    """Return the diagonal of D, the noise of each entry relative to the largest.

    The covariance is that of simulations at one parameter, ``(*batch, l, l)``.
    """
    std = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    largest = std.amax(dim=-1, keepdim=True)
    return torch.where(largest > 0, std / largest, 1.0).clamp_min(SMALLEST_SCALE)


def rounding(covariance: Tensor) -> Tensor:
    """Return the smallest variance of the noise of each entry, ``(*batch, l)``."""
    return (SMALLEST_NOISE * noise_scale(covariance)).square()


@dataclass(frozen=True, eq=False, kw_only=True)
class Term:
    """The posterior at one setting of the hyper-parameters, or a batch of these."""

    coefficients: Tensor  # the mean of (A, b)', (*batch, l + 1, l)
    row_factor: Tensor  # of the covariance of its rows, (*batch, l + 1, l + 1)
    error_factor: Tensor  # of the scale of Sigma (inverse Wishart), (*batch, l, l)
    degrees: Tensor  # of freedom of Sigma, batch

    def sample(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        r"""Draw :math:`A`, :math:`b` and :math:`\Sigma`, ``count`` of each term."""
        *batch, width, _ = self.error_factor.shape
        like = self.error_factor
        # The Bartlett decomposition: T T' follows a Wishart distribution, so that
        # L (T T')^-1 L' follows an inverse Wishart distribution with scale L L'.
        degrees = self.degrees[..., None] - torch.arange(width).to(like)
        triangle = torch.randn(count, *batch, width, width).to(like).tril(-1)
        triangle = triangle + torch.diag_embed(Chi2(degrees).sample((count,)).sqrt())
        identity = torch.eye(width).to(like).expand_as(triangle)
        inverse = torch.linalg.solve_triangular(triangle, identity, upper=False)
        factor = self.error_factor @ inverse.mT
        noise = torch.randn(count, *self.coefficients.shape).to(like)
        coefficients = self.coefficients + self.row_factor @ noise @ factor.mT
        gain, offset = coefficients[..., :-1, :].mT, coefficients[..., -1, :]
        return gain, offset, factor @ factor.mT


@dataclass(frozen=True, eq=False, kw_only=True)
class Discrepancy:
    """The posterior of gain, offset and error, averaged over the hyper-parameters.

    Attributes:
        terms: The posterior at each setting whose evidence is not negligible.
        shares: The shares of the terms in the evidence, which sum to one.
        noise: The covariance C of simulations at one parameter, shape ``(l, l)``.
        probability_of_none: The probability that the simulator is right.
        log_evidence: Log density of the pairs under a discrepancy, where each group
            counts as one pair.
        log_evidence_of_none: The same if the simulator is right.
        num_pairs: The number of calibration pairs.
        num_independent: How many independent pairs these count as: the sum of their
            weights, or less if pairs of a group have errors in common.
    """

    terms: tuple[Term, ...] = field(repr=False)
    shares: Tensor = field(repr=False)
    noise: Tensor = field(repr=False)
    probability_of_none: float
    log_evidence: float
    log_evidence_of_none: float
    num_pairs: int
    num_independent: float

    @torch.no_grad()
    def sample(
        self, num_draws: int, *, smallest_error: float = 0.01, seed: int | None = None
    ) -> "DiscrepancyDraws":
        r"""Draw gains, offsets and errors.

        A share ``probability_of_none`` of the draws corrects nothing. In the others the
        error is without the simulator's own noise,
        :math:`\Sigma' = \Sigma - A C A^\top`.

        Args:
            num_draws: Number of draws.
            smallest_error: The least root of the eigenvalues of
                :math:`D^{-1} \Sigma' D^{-1}`, see :class:`DiscrepancyModel`.
            seed: Seed of the draws; None uses torch's state.
        """
        none = self.probability_of_none
        shares = torch.cat([(1 - none) * self.shares, self.shares.new_tensor([none])])
        with seeded(seed):
            chosen = torch.multinomial(shares, num_draws, replacement=True)
            *counts, num_none = chosen.bincount(minlength=len(shares)).tolist()
            parts = [
                self._corrections(term, count, smallest_error)
                for term, count in zip(self.terms, counts, strict=True)
                if count
            ]
        no_error = self.noise.new_zeros(num_none, *self.noise.shape)
        no_correction = DiscrepancyDraws(
            gain=no_error + torch.eye(len(self.noise)).to(no_error),
            offset=no_error[:, 0],
            error_factor=no_error,
        )
        return DiscrepancyDraws.joined([*parts, no_correction])

    def _corrections(
        self, term: Term, count: int, smallest_error: float
    ) -> "DiscrepancyDraws":
        gain, offset, covariance = term.sample(count)
        scale = noise_scale(self.noise)
        error = covariance - gain @ self.noise @ gain.mT
        variance, directions = torch.linalg.eigh(error / scale / scale[:, None])
        std = variance.clamp_min(smallest_error**2).sqrt()
        factor = scale[:, None] * directions * std[:, None, :]
        return DiscrepancyDraws(gain=gain, offset=offset, error_factor=factor)


@dataclass(frozen=True, eq=False, kw_only=True)
class DiscrepancyDraws:
    r"""Draws of gain, offset and error.

    Attributes:
        gain: :math:`A`, shape ``(m, l, l)``.
        offset: :math:`b`, shape ``(m, l)``.
        error_factor: F with :math:`\Sigma' = F F^\top`, shape ``(m, l, l)``.
    """

    gain: Tensor
    offset: Tensor
    error_factor: Tensor

    @classmethod
    def joined(cls, parts: "Iterable[DiscrepancyDraws]") -> "DiscrepancyDraws":
        """Return all draws of several sets, one set after the other."""
        all_of = ((one.gain, one.offset, one.error_factor) for one in parts)
        gain, offset, factor = map(torch.cat, zip(*all_of, strict=True))
        return cls(gain=gain, offset=offset, error_factor=factor)

    def __len__(self) -> int:
        return len(self.offset)

    def correct(self, z_s: Tensor, draw: Tensor | None = None) -> Tensor:
        """Return simulations as they would be observed in reality, with own errors.

        Args:
            z_s: Simulations, shape ``(n, l)``.
            draw: The number of the draw for each, shape ``(n,)``, or for each of m
                blocks of ``n / m`` simulations, ``(m,)``; random if None.

        Returns:
            Shape ``(n, l)``, float64.
        """
        z_s = as_batch("z_s", z_s, self.offset.shape[1:])
        if draw is None:
            draw = torch.randint(len(self), (len(z_s),)).to(z_s.device)
        blocks = z_s.double().reshape(len(draw), -1, z_s.shape[1])
        noise = torch.randn(z_s.shape, dtype=torch.double).to(blocks)
        # A matrix for each draw needs a lot of memory if z has many entries.
        size = max(1, MAX_ENTRIES // z_s.shape[1] ** 2)
        corrected = []
        parts = (rows.split(size) for rows in (blocks, draw, noise.reshape_as(blocks)))
        for z, which, standard in zip(*parts, strict=True):
            moved = self.offset[which][:, None] + z @ self.gain[which].mT
            corrected.append(moved + standard @ self.error_factor[which].mT)
        return torch.cat(corrected).reshape_as(z_s)
