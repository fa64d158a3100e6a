"""Simulators of users, and what is found out about them before they are used."""

import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_rope._simulator import Simulator
from sbi_rope.errors import RoPEWarning, SimulationError
from tests import gaussian, problems

OWN_NOISE = torch.Generator().manual_seed(0)


def simulator_of(function: Callable[[Tensor], Tensor]) -> Simulator:
    return Simulator(
        function, problems.box(2), event_shape=torch.Size((2,)), like=torch.zeros(1)
    )


def mixes(theta: Tensor) -> Tensor:
    return theta * theta.norm() + 0.1 * torch.randn_like(theta)


def mixes_with_noise_of_its_own(theta: Tensor) -> Tensor:
    noise = torch.randn(theta.shape, generator=OWN_NOISE)
    return theta * theta.norm() + 0.1 * noise


def centres(theta: Tensor) -> Tensor:
    return theta - theta.mean()


def test_a_simulator_whose_rows_depend_on_each_other_is_called_one_by_one() -> None:
    for function in (mixes, mixes_with_noise_of_its_own, centres):
        with pytest.warns(RoPEWarning, match="rows depend on each other"):
            simulator = simulator_of(function)
        assert not simulator.is_batched
        theta = torch.tensor([[0.3, 0.4], [0.6, -0.8]])
        # The errors of these means are below a twentieth of what mixing changes.
        count = 800
        alone = [sum(function(row) for _ in range(count)) / count for row in theta]
        means = simulator(theta.repeat(count, 1)).unflatten(0, (count, 2)).mean(dim=0)
        assert torch.allclose(means, torch.stack(alone), atol=0.02), function


def has_noise_of_its_own(theta: Tensor) -> Tensor:
    return theta + torch.randn(theta.shape, generator=OWN_NOISE)


def rejects(theta: Tensor) -> Tensor:
    """How many random numbers it takes depends on all rows."""
    x = theta + torch.randn_like(theta)
    while (bad := (x.abs() > 1).any(dim=-1)).any():
        x[bad] = (theta + torch.randn_like(theta))[bad]
    return x


def takes_batches_only(theta: Tensor) -> Tensor:
    return torch.cat([theta[:, :1], theta.square().sum(dim=1, keepdim=True)], dim=1)


def has_noise_of_a_generator_made_anew(theta: Tensor) -> Tensor:
    """How many of its random numbers a row takes depends on the rows before."""
    generator = torch.Generator().manual_seed(int(torch.randint(10**9, ())))
    counts = 1 + (5 * theta[:, 0].abs()).long()
    sums = [
        torch.randn(int(n), generator=generator).sum() / n**0.5 for n in counts.flip(0)
    ]
    return theta + torch.stack(sums)[:, None].flip(0)


def test_simulators_of_batches_are_recognised() -> None:
    for function in (
        gaussian.simulator,
        has_noise_of_a_generator_made_anew,
        has_noise_of_its_own,
        rejects,
        takes_batches_only,
        lambda theta: theta @ torch.tensor([[1.0, 0.3], [-0.2, 0.7]]),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert simulator_of(function).is_batched, function


def test_simulations_are_copies_of_a_buffer_that_is_used_again() -> None:
    buffer = torch.zeros(2)

    def reuses(theta: Tensor) -> Tensor:
        assert theta.ndim == 1
        return buffer.copy_(theta)

    theta = torch.tensor([[0.3, 0.4], [0.6, -0.8]])
    assert torch.equal(simulator_of(reuses)(theta), theta)


def test_a_simulator_that_changes_its_argument_changes_a_copy() -> None:
    for batched in (True, False):

        def changes(theta: Tensor) -> Tensor:
            assert batched or theta.ndim == 1  # noqa: B023
            x = theta.clone()
            theta.mul_(0)
            return x

        theta = torch.tensor([[0.3, 0.4], [0.6, -0.8]])
        assert torch.equal(simulator_of(changes)(theta), theta)
        assert torch.equal(theta[0], torch.tensor([0.3, 0.4]))


def test_a_simulator_that_fails_at_its_second_call_is_still_recognised() -> None:
    calls = 0

    def fails_later(theta: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise OSError("busy")
        return torch.zeros_like(theta)

    assert simulator_of(fails_later).is_batched


def adds_up(theta: Tensor) -> Tensor:
    """The first row is right, the others hold those before them."""
    assert theta.ndim == 2
    return theta.cumsum(dim=0)


def flips(theta: Tensor) -> Tensor:
    assert theta.ndim == 2
    return theta.flip(0) + 0.1 * torch.randn_like(theta)


def test_a_simulator_that_mixes_rows_and_takes_no_single_theta_is_refused() -> None:
    for function in (adds_up, flips):
        with pytest.raises(SimulationError, match="changes with the other rows"):
            simulator_of(function)


def test_simulations_that_hold_no_numbers_are_refused() -> None:
    for function in (Tensor.to_sparse, lambda theta: theta.to("meta")):
        with pytest.raises(SimulationError, match="got a tensor of shape"):
            simulator_of(function)


def test_a_simulator_that_sets_the_seed_is_warned_about() -> None:
    def reseeds(theta: Tensor) -> Tensor:
        torch.manual_seed(1)
        return theta + torch.randn_like(theta)

    def reseeds_numpy(theta: Tensor) -> Tensor:
        np.random.seed(1)  # noqa: NPY002
        return theta + torch.randn_like(theta)

    for function in (reseeds, reseeds_numpy):
        with pytest.warns(RoPEWarning, match="sets the seed"):
            simulator_of(function)
