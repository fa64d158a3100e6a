"""The distribution of parameters, learned from those of the calibration pairs."""

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.distributions import Gamma

from sbi_rope.data.parameters import STRENGTHS, _fit
from sbi_rope.discrepancy import learn_parameters

CORRELATION = torch.tensor([[1.0, 0.6], [0.6, 1.0]]).double()


def step_ahead(
    u: np.ndarray, new: np.ndarray, correlation: np.ndarray, strength: float
) -> tuple[float, np.ndarray]:
    """Evidence and predictive density, by one Student t after the other."""
    d = u.shape[1]
    kappa, freedom = strength, strength + d + 1
    mean, scale = np.zeros(d), strength * correlation

    def log_t(at: np.ndarray) -> np.ndarray:
        df = freedom - d + 1
        spread = scale * (kappa + 1) / (kappa * df)
        return stats.multivariate_t.logpdf(at, mean, spread, df=df)

    evidence = 0.0
    for row in u:
        evidence += float(log_t(row))
        away = row - mean
        scale = scale + kappa / (kappa + 1) * np.outer(away, away)
        mean = mean + away / (kappa + 1)
        kappa, freedom = kappa + 1, freedom + 1
    return evidence, np.atleast_1d(log_t(new))


def test_evidence_and_prediction_are_those_of_one_update_after_the_other() -> None:
    for d in (1, 2):
        u = torch.randn(7, d).double() * 0.5 + 0.8
        new, correlation = torch.randn(5, d).double(), CORRELATION[:d, :d]
        for strength in STRENGTHS:
            counts = torch.ones(len(u)).double()
            evidence, log_t = _fit(u, new, counts, correlation, strength)
            expected = step_ahead(u.numpy(), new.numpy(), correlation.numpy(), strength)
            assert float(evidence) == pytest.approx(expected[0], abs=1e-9)
            assert log_t.numpy() == pytest.approx(expected[1], abs=1e-9)


def box(n: int) -> Tensor:
    """Two independent parameters, uniform."""
    return torch.rand(n, 2)


def skewed(n: int) -> Tensor:
    """A heavy tail, and a parameter that depends on it."""
    first = Gamma(0.5, 1.0).sample((n, 1))
    return torch.cat([first, 3 * first + Gamma(2.0, 0.1).sample((n, 1))], dim=1)


@pytest.mark.medium
def test_pairs_from_the_prior_hardly_change_it() -> None:
    improbable = 0
    for prior in (box, skewed):
        for n in (1, 10, 100):
            theta = prior(5000)
            learned = [learn_parameters(prior(n), theta) for _ in range(20)]
            probability = torch.tensor([one.probability_of_prior for one in learned])
            assert float(probability.median()) > (0.75 if n == 100 else 0.45), n
            improbable += int((probability < 0.05).sum())
    # By Markov's inequality, at most one in 19 of these 120 sets of pairs is expected.
    assert improbable <= 120 / 19


def test_weighted_simulations_have_the_mean_and_spread_of_the_pairs() -> None:
    theta = torch.randn(50_000, 1)
    p = learn_parameters(1.0 + 0.5 * torch.randn(300, 1), theta).probabilities
    mean = float(p @ theta[:, 0].double())
    std = float(p @ (theta[:, 0].double() - mean).square()) ** 0.5
    assert (mean, std) == pytest.approx((1.0, 0.5), abs=0.1)


def test_discrete_parameters_are_left_out() -> None:
    n = 20_000
    theta = torch.stack([torch.rand(n), (torch.arange(n) < n // 20).float()], dim=1)
    for ones in (0, 10, 100):
        pairs = torch.stack([torch.rand(100), (torch.arange(100) < ones).float()], 1)
        learned = learn_parameters(pairs, theta)
        assert learned.probability_of_prior > 0.5, ones
        both = learn_parameters(pairs[:, :1], theta[:, :1])
        assert torch.allclose(learned.probabilities, both.probabilities, atol=1e-9)
    assert learn_parameters(pairs[:, 1:], theta[:, 1:]).probability_of_prior == 0.5
    # Rounded labels of people who differ in a discrete parameter only are no copies.
    middle = (pairs[:, :1] / 5 + 0.4).mul(20).round() / 20
    people = torch.cat([middle, (torch.arange(100) % 2)[:, None]], dim=1)
    theta[:, 1] = (torch.arange(n) % 2).float()
    assert learn_parameters(people, theta).probability_of_prior < 0.05


def test_labels_that_are_rounded_to_the_bounds_are_draws_from_the_prior() -> None:
    probabilities = [
        learn_parameters(torch.linspace(0, 1, k)[:, None], theta).probability_of_prior
        for theta in (torch.rand(2000, 1), torch.rand(200_000, 1))
        for k in (5, 10)
    ]
    assert min(probabilities) > 0.5
    # However many simulations there are.
    assert probabilities[:2] == pytest.approx(probabilities[2:], abs=0.02)


def test_several_recordings_of_a_person_count_once() -> None:
    theta, people = box(2000), box(4)
    once = learn_parameters(people, theta)
    often = learn_parameters(people.repeat_interleave(25, dim=0), theta)
    assert often.probability_of_prior == pytest.approx(once.probability_of_prior)
    assert torch.allclose(often.probabilities, once.probabilities)
