"""Regressions of real observations on simulated means, and their evidence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

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

    Attributes:
        coefficients: Means of :math:`(A, b)^\top`, shape ``(K, l + 1, l)``.
        row_factor: Lower Cholesky factors of the covariances of their rows, shape
            ``(K, l + 1, l + 1)``.
        variances: Eigenvalues of the scatter matrices of the residuals, shape
            ``(K, l)``.
        directions: Their eigenvectors, shape ``(K, l, l)``.
        log_volume: The parts of the log evidences that come from the coefficients, and
            from the correlation of the errors, shape ``(K,)``.
        num_pairs: The number of calibration pairs, or the sum of their weights.
    """

    coefficients: Tensor
    row_factor: Tensor
    variances: Tensor
    directions: Tensor
    log_volume: Tensor
    num_pairs: float

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
        """
        n, width = z.shape
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[:, :1])], dim=1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = z.new_tensor(gain_precisions)[:, None].repeat(1, width + 1)
        precision[:, -1] *= OFFSET_PRECISION
        # Relative to the prior mean, residuals are small, and so are rounding errors.
        residual = z - design @ prior_mean
        if weights is not None:
            n = float(weights.sum())
            residual = residual * weights.sqrt()[:, None]
            design = design * weights.sqrt()[:, None]
        num_rounded, log_det_errors = n, 0.0
        if errors is not None:
            residual, design = errors.independent(residual), errors.independent(design)
            num_rounded, log_det_errors = errors.trace_of_inverse, errors.log_det
        factor = torch.linalg.cholesky(torch.diag_embed(precision) + design.T @ design)
        shift = torch.cholesky_solve(design.T @ residual, factor)
        # This is a sum of squares. The usual difference of two terms could be negative.
        left_over = residual - design @ shift
        scatter = left_over.mT @ left_over + shift.mT @ (precision[..., None] * shift)
        # No z is known more precisely than SMALLEST_NOISE, even if pairs agree exactly.
        # Pairs are rounded one by one, whatever the errors of a group have in common.
        scatter = scatter + num_rounded * SMALLEST_NOISE**2 * identity
        variances, directions = torch.linalg.eigh(scatter)
        log_det = 2 * factor.diagonal(dim1=1, dim2=2).log().sum(dim=1)
        log_prior = precision.log().sum(dim=1)
        return cls(
            coefficients=prior_mean + shift,
            row_factor=torch.linalg.cholesky(torch.cholesky_inverse(factor)),
            variances=variances.clamp_min(0.0),
            directions=directions,
            log_volume=width / 2 * (log_prior - log_det - log_det_errors),
            num_pairs=n,
        )

    def log_evidence(self, settings: Sequence[tuple[float, float]]) -> Tensor:
        """Return the log density of the pairs for each precision and setting.

        Args:
            settings: S pairs of an error scale and its strength.

        Returns:
            Shape ``(K, S)``.
        """
        n, width = self.num_pairs, self.variances.shape[1]
        error_scale, strength = self.variances.new_tensor(settings).unbind(dim=1)
        scale = strength * error_scale.square()
        degrees = strength + width + 1
        log_det = (self.variances[:, None] + scale[:, None]).log().sum(dim=2)
        return (
            -n * width / 2 * math.log(math.pi)
            + self.log_volume[:, None]
            + degrees / 2 * width * scale.log()
            - (degrees + n) / 2 * log_det
            + torch.special.multigammaln((degrees + n) / 2, width)
            - torch.special.multigammaln(degrees / 2, width)
        )

    def at(self, number: int, error_scale: float, strength: float) -> Term:
        """Return the posterior at one of the precisions, an error scale and strength.

        Args:
            number: Of the precision, from 0.
            error_scale: The error scale.
            strength: Its strength.
        """
        scale = self.variances[number] + strength * error_scale**2
        return Term(
            coefficients=self.coefficients[number],
            row_factor=self.row_factor[number],
            error_factor=self.directions[number] * scale.sqrt(),
            degrees=strength + len(scale) + 1 + self.num_pairs,
        )
