"""The pendulum."""

import math

import pytest
import torch

from sbi_rope.tasks.pendulum import Pendulum, PendulumSimulator


def test_positions_are_a_damped_cosine() -> None:
    theta = torch.tensor([[0.0, 2.0], [math.pi, 3.0]], dtype=torch.float64)
    damping = torch.tensor([[0.0], [0.5]])
    x = PendulumSimulator().position(theta, phase=0 * damping, damping=damping)
    torch.testing.assert_close(x[0], torch.full((200,), 2.0, dtype=torch.float64))
    assert x[1, 0] == pytest.approx(3.0)
    # pi rad/s for 10 s are five full turns.
    assert x[1, -1] == pytest.approx(3.0 * math.exp(-5.0))


def test_phase_is_uniform_on_the_circle() -> None:
    # The swing turns by a quarter in 10 s: first and last position give the phase.
    theta = torch.tensor([[math.pi / 20, 1.0]]).expand(10_000, -1)
    x = PendulumSimulator(noise_std=1e-3)(theta)
    phase = torch.atan2(-x[:, -1], x[:, 0])
    levels = torch.linspace(0.05, 0.95, 10)
    expected = math.pi * (2 * levels - 1)
    torch.testing.assert_close(phase.quantile(levels), expected, atol=0.1, rtol=0.0)


def test_simulations_are_not_damped_and_real_series_are() -> None:
    theta, x_o = Pendulum().get_test_set(2000)
    x_s = Pendulum().get_simulator()(theta)
    amplitude = theta[:, 1:]

    def power(x: torch.Tensor, step: slice) -> float:
        return float((x[:, step] / amplitude).square().mean())

    assert power(x_s, slice(-20, None)) == pytest.approx(0.5, abs=0.05)
    # The mean of exp(-2 alpha t) over alpha in (0, 1) is about 1 / (2 t).
    assert power(x_o, slice(0, 3)) == pytest.approx(0.45, abs=0.05)
    assert power(x_o, slice(-20, None)) == pytest.approx(0.5 / 19, rel=0.25)


def test_the_weight_is_the_share_of_the_tighter_distribution() -> None:
    low, high = torch.tensor([1.0, 3.0]), torch.tensor([2.0, 6.0])
    for weight in (0.0, 0.3, 1.0):
        task = Pendulum(variant="misspecified_prior", misspecification_weight=weight)
        for theta, _ in (task.get_calibration_set(2000), task.get_test_set(2000)):
            inside = ((theta >= low) & (theta <= high)).all(dim=1).double().mean()
            expected = weight + (1 - weight) * 3 / 28.5
            assert inside == pytest.approx(expected, abs=0.04)
    assert Pendulum(variant="misspecified_prior").misspecification_weight == 0.5
    assert Pendulum().misspecification_weight == 0.0
