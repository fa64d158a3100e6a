"""Regressions of real observations on simulated means, and their evidence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_rope.discrepancy.correlation import GroupErrors
from sbi_rope.discrepancy.posterior import Term

__all__ = ["SMALLEST_NOISE", "Regressions"]

# The prior precision of the offset is this share of the precision of the gain.
OFFSET_PRECISION = 1 / 3
# This standard deviation is added to the noise of simulations at one parameter, because
# some statistics have no noise at all. Its unit is the standard deviation of
# simulations from the prior.
SMALLEST_NOISE = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class Regressions:
    r"""Real observations regressed on simulated means, at K precisions of the gain.

    There may be several means of each observation, such as imputed ones. Each set of
    them has its own regressions, and ``*batch`` is the shape of the sets.

    Attributes:
        coefficients: Means of :math:`(A, b)^\top`, shape ``(*batch, K, l + 1, l)``.
        row_factor: Lower Cholesky factors of the covariances of their rows, shape
            ``(*batch, K, l + 1, l + 1)``.
        variances: Eigenvalues of the scatter matrices of the residuals, shape
            ``(*batch, K, l)``.
        directions: Their eigenvectors, shape ``(*batch, K, l, l)``.
        log_volume: The parts of the log evidences that come from the coefficients, and
            from the correlation of the errors, shape ``(*batch, K)``.
        num_pairs: The number of calibration pairs, or the sum of their weights, shape
            ``batch``.
    """

    coefficients: Tensor
    row_factor: Tensor
    variances: Tensor
    directions: Tensor
    log_volume: Tensor
    num_pairs: Tensor

    @classmethod
    def of(
        cls,
        z: Tensor,
        mean: Tensor,
        gain_precisions: Sequence[float],
        *,
        weights: Tensor | None = None,
        errors: GroupErrors | None = None,
    ) -> "Regressions":
        """Return the conjugate posterior of the coefficients at each precision.

        Either weights or the correlations of the errors are given, or none of them.

        Args:
            z: Representations of the real observations, shape ``(n, l)``.
            mean: The means of simulations at their parameters, ``(*batch, n, l)``.
            gain_precisions: K values of k.
            weights: How many pairs each pair counts as, shape ``(n,)`` or
                ``(*batch, n)``; one if None.
            errors: Their correlations within groups; none if None.
        """
        *batch, n, width = mean.shape
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[..., :1])], dim=-1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = z.new_tensor(gain_precisions)[:, None].repeat(1, width + 1)
        precision[:, -1] *= OFFSET_PRECISION
        # Relative to the prior mean, residuals are small, and so are rounding errors.
        residual = z - design @ prior_mean
        num_pairs = z.new_tensor(n)
        if weights is not None:
            num_pairs = weights.sum(dim=-1)
            residual = residual * weights.sqrt()[..., None]
            design = design * weights.sqrt()[..., None]
        num_pairs = num_pairs.expand(batch)
        num_rounded, log_det_errors = num_pairs[..., None, None, None], 0.0
        if errors is not None:
            residual, design = errors.independent(residual), errors.independent(design)
            num_rounded, log_det_errors = errors.trace_of_inverse, errors.log_det
        # From here on there is a dimension for the K precisions.
        design, residual = design[..., None, :, :], residual[..., None, :, :]
        factor = torch.linalg.cholesky(torch.diag_embed(precision) + design.mT @ design)
        shift = torch.cholesky_solve(design.mT @ residual, factor)
        # This is a sum of squares. The usual difference of two terms could be negative.
        left_over = residual - design @ shift
        scatter = left_over.mT @ left_over + shift.mT @ (precision[..., None] * shift)
        # No z is known more precisely than SMALLEST_NOISE, even if pairs agree exactly.
        # Pairs are rounded one by one, whatever the errors of a group have in common.
        scatter = scatter + num_rounded * SMALLEST_NOISE**2 * identity
        variances, directions = torch.linalg.eigh(scatter)
        log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        log_prior = precision.log().sum(dim=1)
        return cls(
            coefficients=prior_mean + shift,
            row_factor=torch.linalg.cholesky(torch.cholesky_inverse(factor)),
            variances=variances.clamp_min(0.0),
            directions=directions,
            log_volume=width / 2 * (log_prior - log_det - log_det_errors),
            num_pairs=num_pairs,
        )

    def log_evidence(self, settings: Sequence[tuple[float, float]]) -> Tensor:
        """Return the log density of the pairs for each precision and setting.

        Args:
            settings: S pairs of an error scale and its strength.

        Returns:
            Shape ``(*batch, K, S)``.
        """
        n, width = self.num_pairs[..., None, None], self.variances.shape[-1]
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

    def at(self, where: tuple[Any, ...], error_scale: Any, strength: Any) -> Term:
        """Return the posterior at one of the precisions, an error scale and strength.

        Args:
            where: Index of the precision in ``(*batch, K)``. Indices are numbers, or
                tensors of shape ``(m,)`` for m terms in one.
            error_scale: The error scale, a number or of shape ``(m,)``.
            strength: Its strength, likewise.
        """
        like = self.variances
        strength = torch.as_tensor(strength).to(like)
        smallest = strength * torch.as_tensor(error_scale).to(like).square()
        scale = like[where] + smallest[..., None]
        return Term(
            coefficients=self.coefficients[where],
            row_factor=self.row_factor[where],
            error_factor=self.directions[where] * scale[..., None, :].sqrt(),
            degrees=strength + scale.shape[-1] + 1 + self.num_pairs[where[:-1]],
        )
