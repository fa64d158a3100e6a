r"""A Bayesian linear model of how real observations differ from simulations."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Chi2, MultivariateNormal

from sbi_rope._random import seeded
from sbi_rope._validation import (
    check_batch,
    check_integer,
    check_not_negative,
    check_positive,
    check_same_length,
    check_tensor,
    check_unit_interval,
)
from sbi_rope.errors import InvalidInputError, InvalidTypeError

__all__ = ["Discrepancy", "DiscrepancyDraws", "DiscrepancyModel"]

# Settings of the hyper-parameters are left out if their evidence is less than this
# share of that of the best.
NEGLIGIBLE = 1e-4
# The prior is less certain of the offset than of the gain, by this factor.
OFFSET_PRECISION = 1 / 3
# Entries of the matrices that simulations are corrected by at a time.
MAX_ENTRIES = 2**22
# Smallest standard deviation that simulations at one parameter are given, in standard
# deviations of simulations from the prior: some statistics have no noise at all.
SMALLEST_NOISE = 0.01


@dataclass(frozen=True, kw_only=True)
class DiscrepancyModel:
    r"""How real observations follow from simulations: a gain, an offset and an error.

    Let z be what an observation is represented by, such as its embedding. With
    :math:`m_i` and C the mean and the covariance of simulations :math:`z_s` at the
    parameters of calibration pair i,

    .. math::
        z_o = A z_s + b + e, \quad e \sim \mathcal N(0, \Sigma')
        \qquad\Rightarrow\qquad
        z_i \mid \theta_i \sim \mathcal N(A m_i + b,\; \Sigma), \quad
        \Sigma = \Sigma' + A C A^\top .

    The prior is conjugate and centred on a simulator that is right,

    .. math::
        \Sigma \sim \mathrm{IW}\bigl((\nu - l - 1)\, s^2 I, \nu\bigr), \qquad
        (A, b) \mid \Sigma \sim \mathcal{MN}\bigl((I, 0), K^{-1}, \Sigma\bigr), \quad
        K = \operatorname{diag}(k, \ldots, k, k / 3),

    so that the posterior has the same form and the evidence is known in closed form.
    The hyper-parameters k, s and :math:`\nu` are averaged over a grid by their
    evidence, so that a user has nothing to choose.

    The model :math:`z_i \mid \theta_i \sim \mathcal N(m_i, C)`, in which the simulator
    is right, takes part in the average. Its share is ``probability_of_none`` before any
    pair is seen. Where the simulator is right its share goes to one, and nothing is
    corrected; unless the noise of z varies several times with the parameters, which one
    C for all does not describe.

    All quantities are in standard deviations of simulations from the prior.

    References:
        | Bayesian Calibration of Computer Models (Kennedy and O'Hagan, 2001)
        | https://doi.org/10.1111/1467-9868.00294

    Args:
        gain_precisions: Values of k.
        error_scales: Values of s.
        degrees_of_freedom: Values of :math:`\nu - l - 1`, the number of pairs that the
            prior of the error is worth.
        probability_of_none: How probable it is beforehand that the simulator is right.

    Raises:
        InvalidTypeError: If one of the first three is not a list.
        InvalidInputError: If a list is empty or a number is outside its range.

    Example:
        >>> z_s = torch.linspace(-1.0, 1.0, 20)[:, None]
        >>> noise = torch.tensor([[0.01]])
        >>> discrepancy = DiscrepancyModel().fit(0.5 * z_s + 2.0, z_s, noise)
        >>> draws = discrepancy.sample(1000, seed=0)
        >>> round(float(draws.gain.mean()), 1), round(float(draws.offset.mean()), 1)
        (0.5, 2.0)
        >>> discrepancy.probability_of_none < 1e-3
        True
    """

    gain_precisions: Sequence[float] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 1000.0)
    error_scales: Sequence[float] = (0.01, 0.03, 0.05, 0.1, 0.2, 0.4, 0.8)
    degrees_of_freedom: Sequence[float] = (1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
    probability_of_none: float = 0.5

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        for name in ("gain_precisions", "error_scales", "degrees_of_freedom"):
            values = getattr(self, name)
            if not isinstance(values, Sequence):
                raise InvalidTypeError(
                    f"Expected `{name}` to be a list of numbers; got {values!r}."
                )
            if not len(values):
                raise InvalidInputError(f"Expected at least one of `{name}`; got none.")
            for value in values:
                check_positive(name, value)
        check_unit_interval("probability_of_none", self.probability_of_none)

    def fit(self, z: Tensor, mean: Tensor, covariance: Tensor) -> "Discrepancy":
        r"""Return the posterior of the discrepancy given calibration pairs.

        Args:
            z: Real observations, shape ``(n, l)``.
            mean: :math:`m_i`, the mean of simulations at the parameters of each, shape
                ``(n, l)``.
            covariance: C, the covariance of simulations at one parameter, averaged over
                the pairs, shape ``(l, l)``.

        Returns:
            The posterior, in float64.

        Raises:
            InvalidInputError: If the shapes do not fit, a value is not finite, or
                ``covariance`` is none.
        """
        z, mean, covariance = _checked(z, mean, covariance)
        noise = covariance + SMALLEST_NOISE**2 * torch.eye(z.shape[1]).to(z)
        settings = list(itertools.product(self.error_scales, self.degrees_of_freedom))
        regressions = [_Regression.of(z, mean, k) for k in self.gain_precisions]
        evidence = torch.stack([r.log_evidence(settings) for r in regressions])
        average = evidence.logsumexp(dim=(0, 1)) - math.log(evidence.numel())
        right = _log_evidence_of_none(z - mean, noise)
        probability = _posterior_probability(self.probability_of_none, right - average)
        kept = evidence > evidence.max() + math.log(NEGLIGIBLE)
        terms = [regressions[i].at(*settings[j]) for i, j in kept.nonzero().tolist()]
        return Discrepancy(
            terms=tuple(terms),
            shares=torch.softmax(evidence[kept], dim=0),
            noise=noise,
            probability_of_none=probability,
            log_evidence=float(average),
            log_evidence_of_none=float(right),
            num_pairs=len(z),
        )


def _checked(z: Any, mean: Any, covariance: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return what describes the pairs in float64."""
    z = check_tensor("z", z).double()
    if z.ndim != 2:
        raise InvalidInputError(
            f"Expected `z` of shape (n, l); got {tuple(z.shape)}. Flatten it first."
        )
    width = z.shape[1]
    z = check_batch("z", z, (width,))
    mean = check_batch("mean", mean, (width,)).to(z)
    check_same_length("z", z, "mean", mean)
    covariance = check_batch("covariance", covariance, (width,)).to(z)
    if len(covariance) != width:
        raise InvalidInputError(
            f"Expected `covariance` of shape {(width, width)}; got "
            f"{tuple(covariance.shape)}."
        )
    smallest = torch.linalg.eigvalsh(covariance)[0]
    margin = 1e-8 * covariance.diagonal().abs().max()
    if smallest < -margin or not torch.allclose(covariance, covariance.mT):
        raise InvalidInputError(
            "Expected `covariance` to be symmetric without negative eigenvalues; the "
            f"smallest is {float(smallest):.3g}."
        )
    return z, mean, covariance


def _log_evidence_of_none(residual: Tensor, noise: Tensor) -> Tensor:
    """Return the log density of z - m, measured as finely as ``_Regression`` takes."""
    log_density = MultivariateNormal(torch.zeros_like(residual[0]), noise).log_prob
    inexact = len(residual) * SMALLEST_NOISE**2 * torch.linalg.inv(noise).trace()
    return log_density(residual).sum() - inexact / 2


def _posterior_probability(prior: float, log_bayes_factor: Tensor) -> float:
    if prior in (0.0, 1.0):
        return prior
    return float(torch.sigmoid(log_bayes_factor + math.log(prior / (1.0 - prior))))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Regression:
    r"""Real observations regressed on simulated means, at one precision of the gain.

    Attributes:
        coefficients: Mean of :math:`(A, b)^\top`, shape ``(l + 1, l)``.
        row_factor: Lower Cholesky factor of the covariance of its rows.
        variances: Eigenvalues of the squares that are left over, shape ``(l,)``.
        directions: Their eigenvectors, shape ``(l, l)``.
        log_volume: What the coefficients add to the log evidence.
        num_pairs: Pairs behind it.
    """

    coefficients: Tensor
    row_factor: Tensor
    variances: Tensor
    directions: Tensor
    log_volume: Tensor
    num_pairs: int

    @classmethod
    def of(cls, z: Tensor, mean: Tensor, gain_precision: float) -> "_Regression":
        """Return the conjugate posterior of the coefficients."""
        n, width = z.shape
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[:, :1])], dim=1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        precision = torch.full((width + 1,), gain_precision).to(z)
        precision[-1] *= OFFSET_PRECISION
        # Relative to the prior mean, where squares are small and so is their rounding.
        residual = z - design @ prior_mean
        factor = torch.linalg.cholesky(precision.diag() + design.T @ design)
        shift = torch.cholesky_solve(design.T @ residual, factor)
        # A sum of squares, where the usual difference of two could be negative.
        left_over = residual - design @ shift
        scatter = left_over.T @ left_over + shift.T @ (precision[:, None] * shift)
        # What is the same to more digits than anything is measured is no better known.
        scatter = scatter + n * SMALLEST_NOISE**2 * identity
        variances, directions = torch.linalg.eigh(scatter)
        log_det = 2 * factor.diagonal().log().sum()
        return cls(
            coefficients=prior_mean + shift,
            row_factor=torch.linalg.cholesky(torch.cholesky_inverse(factor)),
            variances=variances.clamp_min(0.0),
            directions=directions,
            log_volume=width / 2 * (precision.log().sum() - log_det),
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

    def at(self, error_scale: float, strength: float) -> "_Term":
        """Return the posterior at one error scale and strength."""
        scale = self.variances + strength * error_scale**2
        return _Term(
            coefficients=self.coefficients,
            row_factor=self.row_factor,
            error_factor=self.directions * scale.sqrt(),
            degrees=strength + len(scale) + 1 + self.num_pairs,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Term:
    r"""The posterior at one setting of the hyper-parameters.

    Attributes:
        coefficients: Mean of :math:`(A, b)^\top`, shape ``(l + 1, l)``.
        row_factor: Lower Cholesky factor of the covariance of its rows.
        error_factor: L, with :math:`L L^\top` the scale of the inverse Wishart
            distribution of :math:`\Sigma`, shape ``(l, l)``.
        degrees: Its degrees of freedom.
    """

    coefficients: Tensor
    row_factor: Tensor
    error_factor: Tensor
    degrees: float

    def sample(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        r"""Draw :math:`A`, :math:`b` and :math:`\Sigma`."""
        width, like = len(self.error_factor), self.error_factor
        # Bartlett: T T' is Wishart, and with L L' the scale, L (T T')^-1 L' is inverse
        # Wishart.
        degrees = self.degrees - torch.arange(width).to(like)
        triangle = torch.randn(count, width, width).to(like).tril(-1)
        triangle = triangle + torch.diag_embed(Chi2(degrees).sample((count,)).sqrt())
        identity = torch.eye(width).to(like).expand_as(triangle)
        inverse = torch.linalg.solve_triangular(triangle, identity, upper=False)
        factor = self.error_factor @ inverse.mT
        noise = torch.randn(count, *self.coefficients.shape).to(like)
        coefficients = self.coefficients + self.row_factor @ noise @ factor.mT
        return coefficients[:, :-1].mT, coefficients[:, -1], factor @ factor.mT


@dataclass(frozen=True, eq=False, kw_only=True)
class Discrepancy:
    """The posterior of gain, offset and error, averaged over the hyper-parameters.

    Attributes:
        terms: The posterior at each setting of the hyper-parameters that matters.
        shares: Their shares of the evidence, which sum to one.
        noise: The covariance C of simulations at one parameter, shape ``(l, l)``.
        probability_of_none: How probable it is that the simulator is right.
        log_evidence: Log density of the pairs under a discrepancy.
        log_evidence_of_none: The same under a simulator that is right.
        num_pairs: Pairs behind it.
    """

    terms: tuple[_Term, ...] = field(repr=False)
    shares: Tensor = field(repr=False)
    noise: Tensor = field(repr=False)
    probability_of_none: float
    log_evidence: float
    log_evidence_of_none: float
    num_pairs: int

    @torch.no_grad()
    def sample(
        self,
        num_draws: int,
        *,
        smallest_error: float = 0.01,
        seed: int | None = None,
    ) -> "DiscrepancyDraws":
        r"""Draw gains, offsets and errors.

        A share ``probability_of_none`` of the draws has gain one, offset zero and no
        error. Of the others the error is what is left of :math:`\Sigma` without the
        simulator's own noise, :math:`\Sigma' = \Sigma - A C A^\top`, whose eigenvalues
        are not allowed to be smaller than ``smallest_error`` squared.

        Args:
            num_draws: Number of draws.
            smallest_error: Smallest standard deviation of the error.
            seed: Seed of the draws; None uses torch's state.

        Returns:
            The draws.

        Raises:
            InvalidInputError: If an argument is outside its range.
        """
        check_integer("num_draws", num_draws)
        check_not_negative("smallest_error", smallest_error)
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
        parts.append(self._no_correction(num_none))
        gain, offset, factor = map(torch.cat, zip(*parts, strict=True))
        return DiscrepancyDraws(gain=gain, offset=offset, error_factor=factor)

    def _corrections(
        self, term: _Term, count: int, smallest_error: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        gain, offset, covariance = term.sample(count)
        error = covariance - gain @ self.noise @ gain.mT
        variance, directions = torch.linalg.eigh(error)
        std = variance.clamp_min(smallest_error**2).sqrt()
        return gain, offset, directions * std[:, None, :]

    def _no_correction(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        width = len(self.noise)
        return (
            torch.eye(width).to(self.noise).expand(count, -1, -1),
            self.noise.new_zeros(count, width),
            self.noise.new_zeros(count, width, width),
        )


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

    def __len__(self) -> int:
        return len(self.offset)

    def correct(self, z_s: Tensor) -> Tensor:
        """Return what would be observed in the place of simulations.

        Each simulation is corrected by a draw chosen at random, with an error of its
        own, so that together they stand for all that is known of the discrepancy.

        Args:
            z_s: Simulations, shape ``(n, l)``.

        Returns:
            Shape ``(n, l)``, float64.

        Raises:
            InvalidInputError: If the shape does not fit or a value is not finite.
        """
        z_s = check_batch("z_s", z_s, self.offset.shape[1:])
        draw = torch.randint(len(self), (len(z_s),)).to(z_s.device)
        noise = torch.randn(z_s.shape, dtype=torch.double).to(z_s.device)
        # A matrix for each simulation takes a lot of memory where z is wide.
        size = max(1, MAX_ENTRIES // z_s.shape[1] ** 2)
        parts = zip(*(rows.split(size) for rows in (z_s, draw, noise)), strict=True)
        return torch.cat([self._corrected(*part) for part in parts])

    def _corrected(self, z_s: Tensor, draw: Tensor, noise: Tensor) -> Tensor:
        moved = (self.gain[draw] @ z_s.double()[..., None])[..., 0]
        error = (self.error_factor[draw] @ noise[..., None])[..., 0]
        return moved + self.offset[draw] + error
