"""The posterior of gain, offset and error, against integrals and simulations."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Regressions, independent_pairs

# Settings of the hyper-parameters k, s and the strength of the error's prior.
SETTINGS = [(0.5, 0.2, 1.0), (3.0, 0.6, 4.0), (30.0, 0.1, 20.0)]
DRAWS = 40_000


def at(k: float, s: float, strength: float) -> DiscrepancyModel:
    """The model at one setting of its hyper-parameters."""
    return DiscrepancyModel(
        gain_precisions=(k,), error_scales=(s,), degrees_of_freedom=(strength,)
    )


def certainly_off(model: DiscrepancyModel) -> DiscrepancyModel:
    return replace(model, probability_of_none=0.0)


def pairs(n: int, width: int, *, error: float = 0.3) -> tuple[Tensor, Tensor]:
    """Real observations with a gain and an offset, and their simulated means."""
    mean = torch.randn(n, width, dtype=torch.double)
    gain = torch.eye(width) + 0.4 * torch.randn(width, width)
    z = mean @ gain.double().T + 0.5 + error * torch.randn(n, width)
    return z, mean


def no_noise(width: int) -> Tensor:
    return torch.zeros(width, width)


@pytest.fixture
def without_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sbi_rope.discrepancy.posterior.SMALLEST_NOISE", 0.0)


exactly = pytest.mark.usefixtures("without_rounding")


def updated(
    z: Tensor,
    mean: Tensor,
    setting: tuple[float, ...],
    shape: Sequence[float] | None = None,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """The posterior by one pair after the other, each predicted by a Student t density.

    Returns the log evidence, the mean of the coefficients, the covariance of their
    rows, and the mean of Sigma.
    """
    k, s, strength = setting
    width = z.shape[1]
    precision = np.diag([k] * width + [k / 3])
    coefficients = np.vstack([np.eye(width), np.zeros((1, width))])
    scale = strength * s**2 * np.diag(np.square(shape or [1.0] * width))
    degrees = strength + width + 1
    total = 0.0
    for y, m in zip(z.numpy(), mean.numpy(), strict=True):
        x = np.append(m, 1.0)
        freedom = degrees - width + 1
        spread = 1 + x @ np.linalg.inv(precision) @ x
        total += stats.multivariate_t.logpdf(
            y, x @ coefficients, scale * spread / freedom, df=freedom
        )
        error = y - x @ coefficients
        scale = scale + np.outer(error, error) / spread
        new = precision + np.outer(x, x)
        coefficients = np.linalg.solve(new, precision @ coefficients + np.outer(x, y))
        precision, degrees = new, degrees + 1
    sigma = scale / (degrees - width - 1)
    return float(total), coefficients, np.linalg.inv(precision), sigma


@exactly
def test_evidence_and_draws_are_those_of_one_update_after_the_other() -> None:
    for width in (1, 2, 4):
        z, mean = pairs(9, width)
        for setting in SETTINGS:
            model = certainly_off(at(*setting))
            discrepancy = model.fit(z, mean, 1e-12 * torch.eye(width))
            evidence, coefficients, rows, sigma = updated(z, mean, setting)
            assert discrepancy.log_evidence == pytest.approx(evidence, abs=1e-8)
            draws = discrepancy.sample(DRAWS, smallest_error=0.0, seed=0)
            drawn = torch.cat([draws.gain, draws.offset[..., None]], dim=2)
            std = np.sqrt(np.outer(np.diag(sigma), np.diag(rows)))
            error = np.abs(drawn.mean(dim=0).numpy() - coefficients.T)
            assert (error < 0.03 * std).all(), setting
            assert drawn.std(dim=0).numpy() == pytest.approx(std, rel=0.04), setting
            total = (draws.error_factor @ draws.error_factor.mT).mean(dim=0)
            error = np.abs(total.numpy() - sigma)
            assert (error < 0.04 * np.diag(sigma).max()).all(), setting


@exactly
def test_the_shape_of_the_error_is_averaged_over_by_evidence() -> None:
    z, mean = pairs(9, 2)
    noise, (k, s, strength) = 1e-10 * torch.tensor([1.0, 0.25]), SETTINGS[0]
    discrepancy = at(k, s, strength).fit(z, mean, noise.diag())
    of_shapes = [
        updated(z, mean, (k, s, strength), shape) for shape in ([1.0, 0.5], [1.0, 1.0])
    ]
    evidence = torch.tensor([one[0] for one in of_shapes]).double()
    average = float(evidence.logsumexp(0)) - math.log(2)
    assert discrepancy.log_evidence == pytest.approx(average, abs=1e-6)
    assert torch.allclose(discrepancy.shares, evidence.softmax(0), atol=1e-6)
    for term, (_, _, _, sigma) in zip(discrepancy.terms, of_shapes, strict=True):
        scale = term.error_factor @ term.error_factor.mT
        found = scale / (float(term.degrees) - 3)
        assert found.numpy() == pytest.approx(sigma, abs=1e-6)


@exactly
def test_the_evidence_of_a_simulator_that_is_right_is_a_normal_density() -> None:
    z, mean = pairs(6, 2)
    noise = torch.tensor([[0.5, 0.2], [0.2, 0.3]]).double()
    model = replace(at(*SETTINGS[0]), probability_of_none=0.2)
    discrepancy = model.fit(z, mean, noise)
    densities = [
        stats.multivariate_normal.logpdf(y, m, noise.numpy())
        for y, m in zip(z.numpy(), mean.numpy(), strict=True)
    ]
    other = 0.8 * math.exp(discrepancy.log_evidence - sum(densities))
    expected = 0.2 / (0.2 + other)
    assert discrepancy.probability_of_none == pytest.approx(expected, rel=1e-8)


@exactly
def test_the_evidence_of_correlated_errors_is_a_matrix_t_density() -> None:
    """With the coefficients and the covariance integrated out by hand."""
    groups = torch.tensor([0, 1, 0, 2, 1, 0, 3])
    n, width, rho = len(groups), 2, 0.6
    z, mean = pairs(n, width)
    design = torch.cat([mean, torch.ones(n, 1)], dim=1)
    rows = rho * (groups[:, None] == groups).double() + (1 - rho) * torch.eye(n)
    for k, s, strength in SETTINGS:
        prior = torch.tensor([1 / k] * width + [3 / k]).double()
        spread = rows + design * prior @ design.T
        scatter = (z - mean).T @ torch.linalg.solve(spread, z - mean)
        degrees, scale = strength + width + 1, strength * s**2 * torch.eye(width)
        expected = (
            -n * width / 2 * math.log(math.pi)
            - width / 2 * spread.logdet()
            + degrees / 2 * scale.double().logdet()
            - (degrees + n) / 2 * (scale + scatter).logdet()
            + torch.special.multigammaln(torch.tensor((degrees + n) / 2), width)
            - torch.special.multigammaln(torch.tensor(degrees / 2), width)
        )
        found = Regressions.of(
            z,
            mean[None],
            torch.ones(n).double(),
            torch.tensor([k]).double(),
            noise=no_noise(width).double(),
            settings=torch.tensor([[s, strength]]).double(),
            groups=groups,
            correlation=rho,
        )
        assert float(found.log_evidence) == pytest.approx(float(expected), abs=1e-4)


def test_a_group_counts_as_many_pairs_as_its_errors_are_independent() -> None:
    def std_of_offset(z: Tensor, mean: Tensor, **options: Tensor) -> float:
        model = certainly_off(DiscrepancyModel())
        found = model.fit(z, mean, no_noise(2), **options)
        return float(found.sample(2000, seed=0).offset.std(dim=0).mean())

    groups = torch.arange(20).repeat(4)
    z, mean = pairs(20, 2)
    copied = z.repeat(4, 1) + 1e-3 * torch.randn(80, 2), mean.repeat(4, 1)
    alone = std_of_offset(z, mean)
    assert std_of_offset(*copied) < 0.6 * alone
    assert std_of_offset(*copied, groups=groups) == pytest.approx(alone, rel=0.15)
    # Four recordings of twenty specimens whose errors have nothing in common.
    apart = mean.repeat(4, 1) + 0.5 + 0.3 * torch.randn(80, 2), mean.repeat(4, 1)
    independent = std_of_offset(*apart)
    assert std_of_offset(*apart, groups=groups) == pytest.approx(independent, rel=0.1)
    once = std_of_offset(*copied, weights=0.25 * torch.ones(80))
    assert once == pytest.approx(alone, rel=0.15)


def test_weights_that_differ_within_a_group_count_by_their_effective_number() -> None:
    # The variance of their mean is that of correlated errors, summed by hand.
    groups, weights, rho = torch.tensor([0, 0, 1]), torch.tensor([2.0, 1.0, 3.0]), 0.5
    of_group = (4 + 1 + rho * 2 * 2 * 1) / 3**2 * (3 / 5)
    found = independent_pairs(groups, rho, weights)
    assert float(found[:2].sum()) == pytest.approx(1 / of_group)
    assert float(found[2]) == 3.0


def test_a_simulator_that_is_right_is_found_right_and_another_is_not() -> None:
    noise = 0.04 * torch.eye(3).double()
    for n in (10, 50, 400):
        mean = torch.randn(n, 3, dtype=torch.double)
        z = mean + 0.2 * torch.randn(n, 3)
        right = DiscrepancyModel().fit(z, mean, noise)
        assert right.probability_of_none > (0.9 if n < 400 else 0.99)
        off = DiscrepancyModel().fit(0.6 * z + 0.5, mean, noise)
        assert off.probability_of_none < 1e-3


def test_some_draws_correct_nothing() -> None:
    z, mean = pairs(30, 2, error=0.1)
    found = DiscrepancyModel().fit(z, mean, 0.0025 * torch.eye(2).double())
    draws = replace(found, probability_of_none=0.3).sample(5000, seed=0)
    none = (draws.error_factor == 0).flatten(1).all(dim=1)
    assert float(none.double().mean()) == pytest.approx(0.3, abs=0.02)
    assert (draws.gain[none] == torch.eye(2)).all()
    assert (draws.offset[none] == 0).all()
    assert float(draws.error_factor[~none].svd().S.min()) >= 0.01 - 1e-9


def test_the_noise_that_the_simulator_has_made_is_taken_off_times_the_gain() -> None:
    model, totals = certainly_off(DiscrepancyModel()), []
    fitted = model.fit(*pairs(30, 2, error=1.0), no_noise(2))
    for noise in (no_noise(2), torch.tensor([[0.04, 0.02], [0.02, 0.09]])):
        one = replace(fitted, noise=noise.double())
        gain, _, factor = one.sample(100, smallest_error=0.0, seed=0)
        assert (gain - torch.eye(2)).abs().mean() > 0.1
        totals.append(factor @ factor.mT + gain @ one.noise @ gain.mT)
    assert torch.allclose(*totals)


def test_simulations_are_corrected_by_gain_offset_and_error() -> None:
    found = certainly_off(DiscrepancyModel()).fit(*pairs(40, 2), no_noise(2))
    draws = found.sample(2000, seed=0)
    z_s = torch.tensor([1.0, -2.0]).expand(100_000, 2)
    corrected = draws.correct(z_s)
    moved = draws.gain @ z_s[0].double() + draws.offset
    total = (draws.error_factor @ draws.error_factor.mT).mean(dim=0) + moved.T.cov()
    assert torch.allclose(corrected.mean(dim=0), moved.mean(dim=0), atol=0.02)
    assert torch.allclose(corrected.T.cov(), total, rtol=0.05, atol=0.01)
    # A draw can serve a block of simulations.
    draws = draws._replace(error_factor=torch.zeros_like(draws.error_factor))
    corrected = draws.correct(z_s[:12], torch.tensor([4, 0, 5]))
    assert torch.allclose(corrected, moved[[4, 0, 5]].repeat_interleave(4, dim=0))


@pytest.mark.medium
def test_imputed_means_lead_to_the_posterior_of_quadrature() -> None:
    # The labels are as noisy as the parameters are spread.
    torch.manual_seed(0)
    k, s, strength, n = 0.3, 0.2, 3.0, 30
    theta = torch.randn(n, 1, 1).double()
    label = theta + torch.randn(n, 1, 1)
    possible = label / 2 + 0.5**0.5 * torch.randn(n, 40, 1).double()
    z = 0.7 * theta[:, 0] + 0.4 + 0.2 * torch.randn(n, 1)
    # Gains, offsets and variances, with the log of their posterior density.
    axes = torch.linspace(0, 1.6, 36), torch.linspace(-0.6, 1.2, 36)
    log_variances = torch.linspace(-7.0, 1.0, 36)
    gain, offset, log_variance = torch.meshgrid(*axes, log_variances, indexing="ij")
    gain, offset, variance = (
        values.double().reshape(-1, 1, 1)
        for values in (gain, offset, log_variance.exp())
    )
    residual = z - gain * possible[..., 0] - offset
    log_density = (-residual.square() / variance / 2).logsumexp(dim=2).sum(dim=1)
    gain, offset, variance = (one.flatten() for one in (gain, offset, variance))
    log_density += (
        -(n + 2) / 2 * variance.log()
        - (k * (gain - 1).square() + k / 3 * offset.square()) / variance / 2
        # An inverse gamma density, times the variance because the grid has its log.
        - (strength + 2) / 2 * variance.log()
        - strength * s**2 / variance / 2
    )
    shares = torch.softmax(log_density, dim=0)

    model, noise = certainly_off(at(k, s, strength)), torch.tensor([[1e-8]])
    draws = [
        model.fit(z, one, noise).sample(4000, smallest_error=0.0, seed=0)
        for one in (possible, possible.flip(1))  # two sets of imputations
    ]
    expected = gain, offset, variance.sqrt()
    for value, *found in zip(expected, *draws, strict=True):
        mean, found = shares @ value, torch.stack(found).abs()
        std = (shares @ (value - mean).square()).sqrt()
        assert abs(found.mean() - mean) < 0.5 * std
        assert found.std() == pytest.approx(float(std), rel=0.25)
