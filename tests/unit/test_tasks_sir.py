"""The epidemic."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sbi_rope.tasks.sir import SIR, SIRSimulator, delay_weekend_reports, summarise

# Means and standard deviations of 20 000 draws of an independent implementation,
# under the prior, with steps of 0.1 days.
MEAN = (7.27, 0.17, 9.38, 3.91, 4.05, 0.9980)
STD = (1.51, 6.38, 1.52, 0.68, 0.60, 0.0014)


def naive_statistics(series: np.ndarray) -> list[float]:
    half, total = 0, series[0]
    while total <= 0.5 * series.sum():
        half += 1
        total += series[half]
    return [
        math.log(np.mean(series)),
        math.log(np.median(series)),
        math.log(np.max(series)),
        math.log(np.argmax(series) + 1),
        math.log(half),
        np.corrcoef(series[:-1], series[1:])[0, 1],
    ]


def test_without_noise_the_numbers_solve_the_ordinary_equations() -> None:
    theta = torch.tensor([[0.45, 0.1], [0.3, 0.25], [0.1, 0.02], [0.2, 0.0]])

    def derivative(_: float, state: np.ndarray, beta: float, gamma: float) -> list:
        s, log_i = state
        return [-beta * s * math.exp(log_i), beta * s - gamma]

    start, options = (0.999, math.log(0.001)), {"rtol": 1e-10, "atol": 1e-12}
    days = {"t_span": (0, 364), "t_eval": np.arange(365)}
    expected = np.stack(
        [
            solve_ivp(derivative, y0=start, args=rates, **days, **options).y[1]
            for rates in theta.double().tolist()
        ]
    )
    coarse, fine = (
        SIRSimulator(volatility=0.0, steps_per_day=steps).infections(theta).numpy()
        for steps in (10, 20)
    )
    error, half = (np.abs(np.log(x / 1e5) - expected).max() for x in (coarse, fine))
    assert error < 0.5
    # A scheme of first order.
    assert half == pytest.approx(error / 2, rel=0.1)
    extrapolated = 2 * np.log(fine / 1e5) - np.log(coarse / 1e5)
    np.testing.assert_allclose(extrapolated, expected, atol=0.01)


@pytest.mark.medium
def test_noise_has_the_variance_of_a_square_root_process() -> None:
    # While nearly all are susceptible, log i moves by the integral of b - gamma, where
    # b has the mean beta and the covariance of an Ornstein-Uhlenbeck process that
    # starts at its mean, with variance sigma^2 gamma beta a day.
    rate, eta, days = 0.02, 0.05, 30
    theta = torch.tensor([[rate, rate]]).expand(5000, -1)
    x = SIRSimulator().infections(theta)
    growth = (x[:, days] / x[:, 0]).log()
    short, long = math.exp(-eta * days), math.exp(-2 * eta * days)
    factor = days - 2 * (1 - short) / eta + (1 - long) / (2 * eta)
    expected = (0.05 * rate / eta) ** 2 * factor
    assert growth.var() == pytest.approx(expected, rel=0.1)
    assert growth.mean() == pytest.approx(0.0, abs=0.005)


def test_the_delay_of_reports_is_that_of_a_loop_over_the_weeks() -> None:
    # The first day of 2021 was a Friday.
    infections = torch.rand(7, 365, dtype=torch.float64)
    before = infections.clone()
    for fraction in (0.0, 0.95, 1.0):
        expected = infections.clone()
        for saturday in range(1, 359, 7):
            for day in (saturday, saturday + 1):
                late = (1 - fraction) * infections[:, day]
                expected[:, day] -= late
                expected[:, saturday + 2] += late
        reported = delay_weekend_reports(infections, fraction)
        torch.testing.assert_close(reported, expected)
        torch.testing.assert_close(reported.sum(dim=1), infections.sum(dim=1))
        assert torch.equal(infections, before)


def test_statistics_are_those_of_a_naive_implementation() -> None:
    epidemics = SIRSimulator().infections(SIR().get_prior().sample((50,)))
    noise = torch.rand(50, 365, dtype=torch.float64)
    for series in (epidemics, noise, delay_weekend_reports(epidemics, 0.5)):
        expected = [naive_statistics(row) for row in series.numpy()]
        np.testing.assert_allclose(summarise(series).numpy(), expected, rtol=1e-9)


@pytest.mark.slow
def test_means_under_the_prior_are_those_of_an_independent_implementation() -> None:
    _, x = SIR().get_simulations(3000)
    mean, std = torch.tensor(MEAN), torch.tensor(STD)
    error = (std**2 / 20_000 + x.var(dim=0) / 3000).sqrt()
    rounding = torch.tensor([0.005] * 5 + [5e-5])
    assert ((x.mean(dim=0) - mean).abs() < 4 * error + rounding).all()
    torch.testing.assert_close(x.std(dim=0), std, rtol=0.1, atol=0.0)


def test_corners_of_the_prior_have_finite_statistics() -> None:
    corners = [[0.5, 0.0], [0.5, 0.5], [1e-6, 1e-6], [0.0, 0.0], [0.5, 1e-30]]
    x = SIRSimulator()(torch.tensor(corners))
    # With both rates at 0 the series is constant and has no correlation.
    assert x.isfinite().all(dim=1).tolist() == [True, True, True, False, True]
