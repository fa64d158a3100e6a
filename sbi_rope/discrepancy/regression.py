r"""The posterior of the discrepancy, given the mean of simulations for each pair."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope.discrepancy.posterior import Discrepancy, Term, noise_scale, rounding

# The prior precision of the offset is this share of the precision of the gain.
OFFSET_PRECISION = 1 / 3
# The prior precision of the gain is at least this times the noise C of each entry and
# the number of entries. Otherwise, the noise of imprecise entries leaks into a precise
# one, along directions in which the means of the pairs do not vary.
LEAST_PRECISION = 4.0
# Settings with less than this share of the evidence of the best one are left out.
NEGLIGIBLE = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupErrors:
    r"""Errors :math:`E \sim \mathcal{MN}(0, R, \Sigma)`, correlated within groups."""

    groups: Tensor  # the number of the group of each pair, from 0 on, (n,)
    correlation: float

    def independent(self, values: Tensor) -> Tensor:
        """Return :math:`R^{-1/2}` times values of the pairs, ``(*batch, n, k)``."""
        *batch, _, width = values.shape
        sizes = self.groups.bincount().to(values)[:, None]
        sums = values.new_zeros(*batch, len(sizes), width)
        sums = sums.index_add(-2, self.groups, values)
        mean = (sums / sizes)[..., self.groups, :]
        of_means = (1 + (sizes - 1) * self.correlation)[self.groups]
        return mean / of_means.sqrt() + (values - mean) / (1 - self.correlation) ** 0.5

    @property
    def eigenvalues(self) -> Tensor:
        """Those of R: of the mean of each group, and of differences within groups."""
        sizes = self.groups.bincount().double()
        of_means = 1 + (sizes - 1) * self.correlation
        within = sizes.new_full((len(self.groups) - len(sizes),), 1 - self.correlation)
        return torch.cat([of_means, within])


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
    """Real observations regressed on B sets of simulated means, at K forms of prior.

    A form is a precision of the gain, and a shape of the error: the identity or D.
    """

    coefficients: Tensor  # means of (A, b)', (B, K, l + 1, l)
    row_factor: Tensor  # of the covariances of their rows, (B, K, l + 1, l + 1)
    shapes: Tensor  # the diagonals of the shapes, (K, l)
    # Eigenvalues and vectors of the scatter matrices of the residuals in units of the
    # shape, (B, K, l) and (B, K, l, l).
    variances: Tensor
    directions: Tensor
    # The parts of the log evidences that come from the coefficients, from the shape,
    # and from the correlation of the errors, (B, K).
    log_volume: Tensor
    num_pairs: Tensor  # the sum of the weights of the pairs, (B,)

    @classmethod
    def of(
        cls,
        z: Tensor,
        mean: Tensor,
        gain_precisions: Sequence[float],
        weights: Tensor,
        noise: Tensor,
        *,
        errors: GroupErrors | None = None,
    ) -> "Regressions":
        """Return the conjugate posterior of the coefficients at each form.

        Means have the shape ``(B, n, l)``, and weights ``(n,)`` or ``(B, n)``. The
        weights are one if ``errors`` are correlated.
        """
        width = mean.shape[2]
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[..., :1])], dim=-1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = z.new_tensor(gain_precisions)[:, None].repeat(1, width + 1)
        precision[:, -1] *= OFFSET_PRECISION
        precision[:, :-1] += LEAST_PRECISION * width * noise.diagonal()
        # Relative to the prior mean, residuals are small, and so are rounding errors.
        residual = z - design @ prior_mean
        num_pairs = weights.sum(dim=-1).expand(len(mean))
        residual = residual * weights.sqrt()[..., None]
        design = design * weights.sqrt()[..., None]
        num_rounded, log_det_errors = num_pairs[:, None, None, None], 0.0
        if errors is not None:
            residual, design = errors.independent(residual), errors.independent(design)
            num_rounded = errors.eigenvalues.reciprocal().sum()
            log_det_errors = errors.eigenvalues.log().sum()
        # From here on there is a dimension for the K precisions.
        design, residual = design[:, None], residual[:, None]
        factor = torch.linalg.cholesky(torch.diag_embed(precision) + design.mT @ design)
        shift = torch.cholesky_solve(design.mT @ residual, factor)
        # This is a sum of squares. The usual difference of two terms could be negative.
        left_over = residual - design @ shift
        scatter = left_over.mT @ left_over + shift.mT @ (precision[..., None] * shift)
        # No z is known more precisely than rounded, even if pairs agree exactly.
        # Pairs are rounded one by one, whatever the errors of a group have in common.
        scatter = scatter + num_rounded * rounding(noise).diag()
        log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        log_volume = width / 2 * (precision.log().sum(1) - log_det - log_det_errors)
        # From here on both shapes follow each other in the dimension of the precisions.
        scale = noise_scale(noise)
        shapes = torch.stack([torch.ones_like(scale), scale]).unique(dim=0)
        several, count = len(shapes), len(precision)
        shapes = shapes.repeat_interleave(count, dim=0)
        scatter = scatter.repeat(1, several, 1, 1) / shapes[:, None] / shapes[..., None]
        variances, directions = torch.linalg.eigh(scatter)
        row_factor = torch.linalg.cholesky(torch.cholesky_inverse(factor))
        log_volume = log_volume.repeat(1, several)
        return cls(
            coefficients=(prior_mean + shift).repeat(1, several, 1, 1),
            row_factor=row_factor.repeat(1, several, 1, 1),
            shapes=shapes,
            variances=variances.clamp_min(0.0),
            directions=directions,
            log_volume=log_volume - num_pairs[:, None] * shapes.log().sum(dim=1),
            num_pairs=num_pairs,
        )

    def log_evidence(self, settings: Sequence[tuple[float, float]]) -> Tensor:
        """Return the log density of the pairs at forms and settings, ``(B, K, S)``."""
        n, width = self.num_pairs[:, None, None], self.variances.shape[-1]
        error_scale, strength = self.variances.new_tensor(settings).unbind(dim=1)
        scale = strength * error_scale.square()
        degrees = strength + width + 1
        log_det = (self.variances[..., None, :] + scale[:, None]).log().sum(dim=-1)
        return (
            -n * width / 2 * math.log(math.pi)
            + self.log_volume[..., None]
            + degrees / 2 * width * scale.log()
            - (degrees + n) / 2 * log_det
            + torch.special.multigammaln((degrees + n) / 2, width)
            - torch.special.multigammaln(degrees / 2, width)
        )

    def at(self, where: tuple[Any, Any], setting: Any) -> Term:
        """Return the posterior at one set, form and setting, or at m, ``(m,)``."""
        error_scale, strength = (torch.as_tensor(s).to(self.variances) for s in setting)
        scale = self.variances[where] + (strength * error_scale.square())[..., None]
        error_factor = self.directions[where] * scale[..., None, :].sqrt()
        return Term(
            coefficients=self.coefficients[where],
            row_factor=self.row_factor[where],
            error_factor=self.shapes[where[1]][..., None] * error_factor,
            degrees=strength + scale.shape[-1] + 1 + self.num_pairs[where[0]],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditional:
    """The posterior of the discrepancy given each of B sets of means."""

    regressions: Regressions  # at K forms of the prior
    log_evidence: Tensor  # at these and S further settings, (B, K, S)
    settings: Sequence[tuple[float, float]]  # error scales and their strengths
    noise: Tensor  # C, the covariance of simulations at one parameter, (l, l)
    # Log densities of the pairs under a discrepancy and if the simulator is right, with
    # each group as one pair, (B,).
    average: Tensor
    right: Tensor
    probability_of_none: Tensor  # (B,)
    num_pairs: int

    def posteriors(self) -> list[Discrepancy]:
        """Return the averages over the settings whose evidence is not negligible."""
        return [self._posterior(*one) for one in enumerate(self.log_evidence)]

    def _posterior(self, number: int, evidence: Tensor) -> Discrepancy:
        kept = evidence > evidence.max() + math.log(NEGLIGIBLE)
        return Discrepancy(
            terms=tuple(
                self.regressions.at((number, k), self.settings[s])
                for k, s in kept.nonzero().tolist()
            ),
            shares=torch.softmax(evidence[kept], dim=0),
            noise=self.noise,
            probability_of_none=float(self.probability_of_none[number]),
            log_evidence=float(self.average[number]),
            log_evidence_of_none=float(self.right[number]),
            num_pairs=self.num_pairs,
            num_independent=float(self.regressions.num_pairs[number]),
        )

    def draw(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a gain, an offset and the covariance of z given theta for each set."""
        probabilities = torch.softmax(self.log_evidence.flatten(1), dim=1)
        chosen = torch.multinomial(probabilities, 1)[:, 0]
        k, s = chosen // len(self.settings), chosen % len(self.settings)
        setting = self.noise.new_tensor(self.settings)[s].unbind(dim=1)
        which = torch.arange(len(chosen), device=chosen.device)
        drawn = self.regressions.at((which, k), setting).sample(1)
        gain, offset, covariance = (values[0] for values in drawn)
        none = torch.rand(len(chosen)).to(gain) < self.probability_of_none
        identity = torch.eye(len(self.noise)).to(gain)
        return (
            torch.where(none[:, None, None], identity, gain),
            offset.masked_fill(none[:, None], 0.0),
            torch.where(none[:, None, None], self.noise, covariance),
        )


def log_density_of_right(residual: Tensor, noise: Tensor, weights: Tensor) -> Tensor:
    """Return the log density of z - m, ``(B,)``, rounded as ``Regressions`` do."""
    log_density = MultivariateNormal(torch.zeros_like(noise[0]), noise).log_prob
    inexact = weights.sum() * (rounding(noise) * torch.linalg.inv(noise).diagonal())
    return (weights * log_density(residual)).sum(dim=1) - inexact.sum() / 2
