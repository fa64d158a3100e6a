"""The regression of real observations on simulated means, and its evidence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.discrepancy.correlation import GroupErrors
from sbi_rope.discrepancy.posterior import Term

__all__ = ["SMALLEST_NOISE", "Regression"]

# The prior precision of the offset is this share of the precision of the gain.
OFFSET_PRECISION = 1 / 3
# This standard deviation is added to the noise of simulations at one parameter, because
# some statistics have no noise at all. Its unit is the standard deviation of
# simulations from the prior.
SMALLEST_NOISE = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class Regression:
    r"""Real observations regressed on simulated means, at one precision of the gain.

    Attributes:
        coefficients: Mean of :math:`(A, b)^\top`, shape ``(l + 1, l)``.
        row_factor: Lower Cholesky factor of the covariance of its rows, shape
            ``(l + 1, l + 1)``.
        variances: Eigenvalues of the scatter matrix of the residuals, shape ``(l,)``.
        directions: Its eigenvectors, shape ``(l, l)``.
        log_volume: The part of the log evidence that comes from the coefficients, and
            from the correlation of the errors.
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
        gain_precision: float,
        *,
        weights: Tensor | None = None,
        errors: GroupErrors | None = None,
    ) -> "Regression":
        """Return the conjugate posterior of the coefficients.

        Either weights or the correlations of the errors are given, or none of them.
        """
        n, width = z.shape
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[:, :1])], dim=1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = torch.full((width + 1,), gain_precision).to(z)
        precision[-1] *= OFFSET_PRECISION
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
        factor = torch.linalg.cholesky(precision.diag() + design.T @ design)
        shift = torch.cholesky_solve(design.T @ residual, factor)
        # This is a sum of squares. The usual difference of two terms could be negative.
        left_over = residual - design @ shift
        scatter = left_over.T @ left_over + shift.T @ (precision[:, None] * shift)
        # No z is known more precisely than SMALLEST_NOISE, even if pairs agree exactly.
        # Pairs are rounded one by one, whatever the errors of a group have in common.
        scatter = scatter + num_rounded * SMALLEST_NOISE**2 * identity
        variances, directions = torch.linalg.eigh(scatter)
        log_det = 2 * factor.diagonal().log().sum()
        return cls(
            coefficients=prior_mean + shift,
            row_factor=torch.linalg.cholesky(torch.cholesky_inverse(factor)),
            variances=variances.clamp_min(0.0),
            directions=directions,
            log_volume=width / 2 * (precision.log().sum() - log_det - log_det_errors),
            num_pairs=n,
        )

    def log_evidence(self, settings: Sequence[tuple[float, float]]) -> Tensor:
        """Return the log density of the pairs for each error scale and strength."""
        n, width = self.num_pairs, len(self.variances)
        error_scale, strength = self.variances.new_tensor(settings).unbind(dim=1)
        scale = strength * error_scale.square()
        degrees = strength + width + 1
        log_det = (self.variances + scale[:, None]).log().sum(dim=1)
        return (
            -n * width / 2 * math.log(math.pi)
            + self.log_volume
            + degrees / 2 * width * scale.log()
            - (degrees + n) / 2 * log_det
            + torch.special.multigammaln((degrees + n) / 2, width)
            - torch.special.multigammaln(degrees / 2, width)
        )

    def at(self, error_scale: float, strength: float) -> Term:
        """Return the posterior at one error scale and strength."""
        scale = self.variances + strength * error_scale**2
        return Term(
            coefficients=self.coefficients,
            row_factor=self.row_factor,
            error_factor=self.directions * scale.sqrt(),
            degrees=strength + len(scale) + 1 + self.num_pairs,
        )
