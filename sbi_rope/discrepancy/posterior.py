"""The posterior of gain, offset and error given means of simulations, and draws."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Chi2, MultivariateNormal

from sbi_rope.utils.seeds import seeded

# The smallest noise of an entry, relative to the largest, that is told apart from none.
SMALLEST_SCALE = 0.01
# The smallest standard deviations of noise and error, in those of simulations from the
# prior, times D. Some statistics have no noise. x can be more precise than h(x).
SMALLEST_NOISE = 0.01
SMALLEST_ERROR = {"embedding": 0.01, "tuned": 0.01, "input": 0.003}
# The prior precision of the offset is this share of the precision of the gain.
OFFSET_PRECISION = 1 / 3
# The prior precision of the gain is at least this times the noise C of each entry and
# the number of entries, or the noise of imprecise entries leaks into a precise one.
LEAST_PRECISION = 4.0
# Settings with less than this share of the evidence of the best one are left out.
NEGLIGIBLE = 1e-4


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
        # The Bartlett decomposition: T T' follows a Wishart distribution, and
        # L (T T')^-1 L' an inverse Wishart distribution with scale L L'.
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
        log_evidence: Log density of the pairs under a discrepancy.
    """

    terms: tuple[Term, ...] = field(repr=False)
    shares: Tensor = field(repr=False)
    noise: Tensor = field(repr=False)
    probability_of_none: float
    log_evidence: float

    @torch.no_grad()
    def sample(
        self, num_draws: int, *, smallest_error: float = 0.01, seed: int | None = None
    ) -> "DiscrepancyDraws":
        r"""Draw gains, offsets and errors.

        A share ``probability_of_none`` of the draws corrects nothing. In the others the
        error is :math:`\Sigma' = \Sigma - A C A^\top`. The eigenvalues of
        :math:`D^{-1} \Sigma' D^{-1}` have roots of at least ``smallest_error``.
        """
        none, scale = self.probability_of_none, noise_scale(self.noise)
        shares = torch.cat([(1 - none) * self.shares, self.shares.new_tensor([none])])
        with seeded(seed):
            chosen = torch.multinomial(shares, num_draws, replacement=True)
            *counts, num_none = chosen.bincount(minlength=len(shares)).tolist()
            of_terms = zip(self.terms, counts, strict=True)
            parts = [term.sample(count) for term, count in of_terms if count]
            parts = parts or [self.terms[0].sample(0)]
        gain, offset, covariance = map(torch.cat, zip(*parts, strict=True))
        error = covariance - gain @ self.noise @ gain.mT
        variance, directions = torch.linalg.eigh(error / scale / scale[:, None])
        std = variance.clamp_min(smallest_error**2).sqrt()
        factor = scale[:, None] * directions * std[:, None, :]
        no_error = self.noise.new_zeros(num_none, *self.noise.shape)
        same = no_error + torch.eye(len(scale)).to(no_error)
        draws = (gain, offset, factor), (same, no_error[:, 0], no_error)
        return DiscrepancyDraws.joined(draws)


class DiscrepancyDraws(NamedTuple):
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
    def joined(cls, parts: Iterable[tuple[Tensor, ...]]) -> "DiscrepancyDraws":
        """Return all draws of several sets, one set after the other."""
        return cls(*map(torch.cat, zip(*parts, strict=True)))

    def correct(self, z_s: Tensor, draw: Tensor | None = None) -> Tensor:
        """Return simulations ``(n, l)`` as they would be observed, in float64.

        ``draw`` is the number of the draw for each, ``(n,)``, or for each of m blocks
        of ``n / m`` simulations, ``(m,)``; random if None.
        """
        z_s = z_s.double()
        if draw is None:
            draw = torch.randint(len(self.offset), (len(z_s),)).to(z_s.device)
        noise = torch.randn(z_s.shape, dtype=torch.double).to(z_s)
        z, noise = (one.reshape(len(draw), -1, z_s.shape[1]) for one in (z_s, noise))
        moved = self.offset[draw][:, None] + z @ self.gain[draw].mT
        return (moved + noise @ self.error_factor[draw].mT).reshape_as(z_s)


def decorrelated(
    values: Tensor, groups: Tensor, correlation: float
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return :math:`R^{-1/2}` times values, log det R and the trace of 1 / R.

    R is the correlation of the errors of n pairs, which have one within groups. Groups
    are numbered from 0 on, ``(n,)``, and values have the shape ``(*batch, n, k)``.
    """
    sizes = groups.bincount().to(values)
    sums = values.new_zeros(*values.shape[:-2], len(sizes), values.shape[-1])
    mean = sums.index_add(-2, groups, values) / sizes[:, None]
    mean = mean[..., groups, :]
    # The eigenvalues of R: of the mean of each group, and of differences within groups.
    of_means, within = 1 + (sizes - 1) * correlation, 1 - correlation
    white = mean / of_means[groups, None].sqrt() + (values - mean) / within**0.5
    num_within = len(groups) - len(sizes)
    log_det = of_means.log().sum() + num_within * math.log(within)
    return white, log_det, of_means.reciprocal().sum() + num_within / within


def independent_pairs(
    groups: Tensor, correlation: float | Tensor, weights: Tensor
) -> Tensor:
    """Return how many independent pairs each counts as (Kish), ``(*batch, n)``."""
    w = weights.double()
    # The effective number of pairs of each group, if their weights differ.
    number = groups.bincount(weights=w).square() / groups.bincount(weights=w.square())
    correlation = torch.as_tensor(correlation).to(w)[..., None]
    return w / (1 + (number[groups] - 1) * correlation)


@dataclass(frozen=True, eq=False, kw_only=True)
class Regressions:
    """Real observations regressed on B sets of simulated means, for all priors.

    A prior has one of K forms, each a precision of the gain and a shape of the error,
    which is the identity or D. It has one of S further settings, each a scale of the
    error and its strength.
    """

    coefficients: Tensor  # means of (A, b)', (B, K, l + 1, l)
    row_factor: Tensor  # of the covariances of their rows, (B, K, l + 1, l + 1)
    shapes: Tensor  # the diagonals of the shapes, (K, l)
    # Eigenvalues and vectors of the scatter matrices of the residuals in units of the
    # shape, (B, K, l) and (B, K, l, l).
    variances: Tensor
    directions: Tensor
    num_pairs: Tensor  # the sum of the weights of the pairs, (B,)
    noise: Tensor  # C, the covariance of simulations at one parameter, (l, l)
    settings: Tensor  # (S, 2)
    log_evidence: Tensor  # the log density of the pairs, (B, K, S)

    @classmethod
    def of(
        cls,
        z: Tensor,
        mean: Tensor,
        weights: Tensor,
        precisions: Tensor,
        *,
        noise: Tensor,
        settings: Tensor,
        groups: Tensor | None = None,
        correlation: float = 0.0,
    ) -> "Regressions":
        """Return the conjugate posteriors of the coefficients and the evidence.

        Means have the shape ``(B, n, l)``, and weights ``(n,)`` or ``(B, n)``. They are
        one if errors are correlated within groups.
        """
        width = mean.shape[2]
        identity = torch.eye(width).to(z)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = precisions[:, None].repeat(1, width + 1)
        precision[:, -1] *= OFFSET_PRECISION
        precision[:, :-1] += LEAST_PRECISION * width * noise.diagonal()
        design = torch.cat([mean, torch.ones_like(mean[..., :1])], dim=-1)
        # Relative to the prior mean, residuals are small, and so are rounding errors.
        rows = torch.cat([z - design @ prior_mean, design], dim=-1)
        rows = rows * weights.sqrt()[..., None]
        num_pairs = weights.sum(dim=-1).expand(len(mean))
        num_rounded, log_det_errors = num_pairs[:, None, None, None], 0.0
        if groups is not None:
            # Pairs are rounded one by one, whatever errors of a group have in common.
            rows, log_det_errors, num_rounded = decorrelated(rows, groups, correlation)
        # From here on there is a dimension for the K precisions.
        residual, design = rows[:, None].split([width, width + 1], dim=-1)
        factor = torch.linalg.cholesky(torch.diag_embed(precision) + design.mT @ design)
        shift = torch.cholesky_solve(design.mT @ residual, factor)
        # This is a sum of squares. The usual difference of two terms could be negative.
        left_over = residual - design @ shift
        scatter = left_over.mT @ left_over + shift.mT @ (precision[..., None] * shift)
        # No z is known more precisely than rounded, even if pairs agree exactly.
        scatter = scatter + num_rounded * rounding(noise).diag()
        log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        log_volume = width / 2 * (precision.log().sum(1) - log_det - log_det_errors)
        row_factor = torch.linalg.cholesky(torch.cholesky_inverse(factor))
        # From here on both shapes follow each other in the dimension of the precisions.
        scale = noise_scale(noise)
        shapes = torch.stack([torch.ones_like(scale), scale]).unique(dim=0)
        several = len(shapes)
        shapes = shapes.repeat_interleave(len(precision), dim=0)
        scatter = scatter.repeat(1, several, 1, 1) / shapes[:, None] / shapes[..., None]
        variances, directions = torch.linalg.eigh(scatter)
        variances = variances.clamp_min(0.0)
        log_volume = log_volume.repeat(1, several)
        log_volume = log_volume - num_pairs[:, None] * shapes.log().sum(dim=1)
        # From here on there is a dimension for the S settings.
        n, (error_scale, strength) = num_pairs[:, None, None], settings.T
        prior_scale, degrees = strength * error_scale.square(), strength + width + 1
        log_det = (variances[..., None, :] + prior_scale[:, None]).log().sum(dim=-1)
        return cls(
            coefficients=(prior_mean + shift).repeat(1, several, 1, 1),
            row_factor=row_factor.repeat(1, several, 1, 1),
            shapes=shapes,
            variances=variances,
            directions=directions,
            num_pairs=num_pairs,
            noise=noise,
            settings=settings,
            log_evidence=-n * width / 2 * math.log(math.pi)
            + log_volume[..., None]
            + degrees / 2 * width * prior_scale.log()
            - (degrees + n) / 2 * log_det
            + torch.special.multigammaln((degrees + n) / 2, width)
            - torch.special.multigammaln(degrees / 2, width),
        )

    def at(self, b: Any, k: Any, s: Any) -> Term:
        """Return the posterior for one set, form and setting, or for m, ``(m,)``."""
        error_scale, strength = self.settings[s].unbind(dim=-1)
        scale = self.variances[b, k] + (strength * error_scale.square())[..., None]
        error_factor = self.directions[b, k] * scale[..., None, :].sqrt()
        return Term(
            coefficients=self.coefficients[b, k],
            row_factor=self.row_factor[b, k],
            error_factor=self.shapes[k][..., None] * error_factor,
            degrees=strength + scale.shape[-1] + 1 + self.num_pairs[b],
        )

    def mean_log_evidence(self) -> Tensor:
        """Return the log of the mean evidence of all priors, ``(B,)``."""
        count = self.log_evidence[0].numel()
        return self.log_evidence.logsumexp(dim=(1, 2)) - math.log(count)

    def posteriors(self, probability_of_none: Tensor) -> list[Discrepancy]:
        """Return for each set the average over settings with evidence for them."""
        found = []
        for b, evidence in enumerate(self.log_evidence):
            kept = evidence > evidence.max() + math.log(NEGLIGIBLE)
            one = Discrepancy(
                terms=tuple(self.at(b, k, s) for k, s in kept.nonzero().tolist()),
                shares=torch.softmax(evidence[kept], dim=0),
                noise=self.noise,
                probability_of_none=float(probability_of_none[b]),
                log_evidence=float(self.mean_log_evidence()[b]),
            )
            found.append(one)
        return found

    def draw(self, probability_of_none: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a gain, an offset and the covariance of z given theta for each set."""
        probabilities = self.log_evidence.flatten(1).softmax(dim=1)
        chosen = torch.multinomial(probabilities, 1)[:, 0]
        b, count = torch.arange(len(chosen), device=chosen.device), len(self.settings)
        drawn = self.at(b, chosen // count, chosen % count).sample(1)
        gain, offset, covariance = (values[0] for values in drawn)
        none = torch.rand(len(chosen)).to(gain) < probability_of_none
        none, identity = none[:, None, None], torch.eye(len(self.noise)).to(gain)
        return (
            torch.where(none, identity, gain),
            offset.masked_fill(none[:, 0], 0.0),
            torch.where(none, self.noise, covariance),
        )


def log_density_of_right(residual: Tensor, noise: Tensor, weights: Tensor) -> Tensor:
    """Return the log density of z - m, ``(B,)``, rounded as ``Regressions`` do."""
    log_density = MultivariateNormal(torch.zeros_like(noise[0]), noise).log_prob
    inexact = weights.sum() * (rounding(noise) * torch.linalg.inv(noise).diagonal())
    return (weights * log_density(residual)).sum(dim=1) - inexact.sum() / 2
