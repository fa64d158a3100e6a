r"""A Bayesian linear model of how real observations differ from simulations."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.distributions import Chi2, MultivariateNormal

from sbi_rope._random import seeded
from sbi_rope._validation import (
    check_batch,
    check_finite,
    check_integer,
    check_not_negative,
    check_positive,
    check_same_length,
    check_tensor,
    check_unit_interval,
)
from sbi_rope.errors import InvalidInputError

__all__ = ["Discrepancy", "DiscrepancyDraws", "DiscrepancyModel"]

# Settings of the hyper-parameters with less than this share of the evidence are left
# out.
NEGLIGIBLE = 1e-4
# The prior is less certain of the offset than of the gain, by this factor.
OFFSET_PRECISION = 1 / 3
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
    corrected.

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
            InvalidInputError: If the shapes do not fit or a value is not finite.
        """
        z = check_tensor("z", z).double()
        check_batch("z", z, z.shape[1:])
        mean = check_batch("mean", mean, z.shape[1:]).to(z)
        check_same_length("z", z, "mean", mean)
        covariance = check_batch("covariance", covariance, z.shape[1:]).to(z)
        check_finite("covariance", covariance)
        noise = covariance + SMALLEST_NOISE**2 * torch.eye(z.shape[1]).to(z)
        grid = itertools.product(
            self.gain_precisions, self.error_scales, self.degrees_of_freedom
        )
        terms = [_Term.of(z, mean, *setting) for setting in grid]
        evidence = torch.stack([term.log_evidence for term in terms])
        average = evidence.logsumexp(dim=0) - math.log(len(terms))
        right = MultivariateNormal(mean, noise).log_prob(z).sum()
        probability = _posterior_probability(self.probability_of_none, right - average)
        shares = torch.softmax(evidence, dim=0)
        kept = [i for i, share in enumerate(shares.tolist()) if share >= NEGLIGIBLE]
        return Discrepancy(
            terms=tuple(terms[i] for i in kept),
            shares=shares[kept] / shares[kept].sum(),
            noise=noise,
            probability_of_none=probability,
            log_evidence=float(average),
            log_evidence_of_none=float(right),
            num_pairs=len(z),
        )


def _posterior_probability(prior: float, log_bayes_factor: Tensor) -> float:
    if prior in (0.0, 1.0):
        return prior
    return float(torch.sigmoid(log_bayes_factor + math.log(prior / (1.0 - prior))))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Term:
    r"""The posterior at one setting of the hyper-parameters.

    Attributes:
        coefficients: Mean of :math:`(A, b)^\top`, shape ``(l + 1, l)``.
        row_factor: Lower Cholesky factor of the covariance of its rows.
        scale: Of the inverse Wishart distribution of :math:`\Sigma`, shape ``(l, l)``.
        degrees: Its degrees of freedom.
        log_evidence: Log density of the pairs.
    """

    coefficients: Tensor
    row_factor: Tensor
    scale: Tensor
    degrees: float
    log_evidence: Tensor

    @classmethod
    def of(
        cls,
        z: Tensor,
        mean: Tensor,
        gain_precision: float,
        error_scale: float,
        strength: float,
    ) -> "_Term":
        """Return the posterior by the conjugate formulas of a linear regression."""
        n, width = z.shape
        identity = torch.eye(width).to(z)
        design = torch.cat([mean, torch.ones_like(mean[:, :1])], dim=1)
        prior_mean = torch.cat([identity, torch.zeros_like(identity[:1])])
        prior_precision = torch.full((width + 1,), gain_precision).to(z)
        prior_precision[-1] *= OFFSET_PRECISION
        prior_degrees = strength + width + 1
        # Relative to the prior mean, where squares are small and so is their rounding.
        residual = z - design @ prior_mean
        factor = torch.linalg.cholesky(prior_precision.diag() + design.T @ design)
        shift = torch.cholesky_solve(design.T @ residual, factor)
        scale = residual.T @ (residual - design @ shift)
        scale = (scale + scale.T) / 2 + strength * error_scale**2 * identity
        degrees = prior_degrees + n
        log_evidence = (
            -n * width / 2 * math.log(math.pi)
            + width / 2 * (prior_precision.log().sum() - _log_det(factor))
            + prior_degrees / 2 * width * math.log(strength * error_scale**2)
            - degrees / 2 * _log_det(torch.linalg.cholesky(scale))
            + torch.special.multigammaln(torch.tensor(degrees / 2).to(z), width)
            - torch.special.multigammaln(torch.tensor(prior_degrees / 2).to(z), width)
        )
        return cls(
            coefficients=prior_mean + shift,
            row_factor=torch.linalg.cholesky(torch.cholesky_inverse(factor)),
            scale=scale,
            degrees=degrees,
            log_evidence=log_evidence,
        )

    def sample(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        r"""Draw :math:`A`, :math:`b` and :math:`\Sigma`."""
        width = len(self.scale)
        # Bartlett: T T' is Wishart, and with L L' the scale, L (T T')^-1 L' is inverse
        # Wishart.
        degrees = self.degrees - torch.arange(width).to(self.scale)
        triangle = torch.randn(count, width, width).to(self.scale).tril(-1)
        triangle = triangle + torch.diag_embed(Chi2(degrees).sample((count,)).sqrt())
        identity = torch.eye(width).to(self.scale).expand_as(triangle)
        inverse = torch.linalg.solve_triangular(triangle, identity, upper=False)
        factor = torch.linalg.cholesky(self.scale) @ inverse.mT
        noise = torch.randn(count, *self.coefficients.shape).to(self.scale)
        coefficients = self.coefficients + self.row_factor @ noise @ factor.mT
        return coefficients[:, :-1].mT, coefficients[:, -1], factor @ factor.mT


def _log_det(factor: Tensor) -> Tensor:
    return 2 * factor.diagonal().log().sum()


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
        """
        draw = torch.randint(len(self), (len(z_s),)).to(z_s.device)
        noise = torch.randn(z_s.shape, dtype=torch.double).to(z_s.device)
        moved = (self.gain[draw] @ z_s.double()[..., None])[..., 0]
        error = (self.error_factor[draw] @ noise[..., None])[..., 0]
        return moved + self.offset[draw] + error
