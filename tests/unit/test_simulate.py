"""Simulators and stored simulations: how they are called, where they fail, moments."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE, parallel
from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import (
    Moments,
    Simulated,
    Source,
    Stored,
    draws,
    moments,
    source_of,
    targets,
)
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning, SimulationError
from tests import gaussian, problems

QUICK = CalibrationFinetuner(max_num_epochs=2)
THETA = torch.tensor([[0.3, 0.4], [0.6, -0.8], [-0.1, 0.9]])


def simulated(function: Callable[[Any], Any], *shape: int, dim: int = 2) -> Simulated:
    return Simulated(function, problems.box(dim), like=torch.zeros(0, *(shape or (2,))))


def itself(x: Tensor) -> Tensor:
    return x


def pairs_at(theta: Tensor) -> Pairs:
    return Pairs.exact(theta, torch.zeros(len(theta), 2))


def moments_at(source: Source, theta: Tensor, count: int) -> Moments:
    return moments(source, pairs_at(theta), count, itself)


RETURNS: dict[str, Callable[[Any], Any]] = {
    "a tensor": torch.as_tensor,
    "an array": np.asarray,
    "a list": lambda x: x.tolist(),
    "a list of parts": list,
}


@pytest.mark.parametrize("returns", RETURNS)
def test_simulators_take_and_return_what_their_authors_prefer(returns: str) -> None:
    for kind, ndim in itertools.product((Tensor, np.ndarray), (1, 2)):

        def doubles(theta: Any) -> Any:
            assert isinstance(theta, kind)  # noqa: B023
            assert theta.ndim == ndim  # noqa: B023
            return RETURNS[returns](2 * theta)

        x = simulated(doubles).simulate(THETA)[0]
        assert x.dtype == torch.float32
        assert torch.equal(x, 2 * THETA)


def test_a_simulator_that_draws_noise_for_one_theta_is_called_row_by_row() -> None:
    """It takes a batch, but all rows would have the same noise."""
    for draw in (torch.randn, lambda d: np.random.standard_normal(d)):  # noqa: NPY002
        source = simulated(lambda theta: theta + draw(2))  # noqa: B023
        x, _ = source.simulate(torch.zeros(50, 2))
        assert len(x.unique(dim=0)) == 50


@pytest.mark.parametrize("shape", [(1,), (2,), (1, 4, 5)])
def test_dimensions_of_size_one_may_be_missing(shape: tuple[int, ...]) -> None:
    numbers = torch.arange(torch.Size(shape).numel()).reshape(shape)

    def batched(theta: Tensor) -> Tensor:
        return (theta[:, 0].reshape(-1, *[1] * len(shape)) + numbers).squeeze()

    def single(theta: Tensor) -> Any:
        assert theta.ndim == 1
        x = (theta[0] + numbers).squeeze()
        return float(x) if x.ndim == 0 else x

    expected = torch.stack([row[0] + numbers for row in THETA])
    for function in (batched, single):
        source = simulated(function, *shape)
        assert torch.equal(source.simulate(THETA)[0], expected)
        assert torch.equal(source.simulate(THETA[:1])[0], expected[:1])


def fails_at_times(theta: Any) -> Any:
    if theta[0] > 0.5:
        raise ArithmeticError("no solution")
    return np.array([theta[0], theta[1]])


def has_gaps(theta: Tensor) -> Tensor:
    return theta.where(theta[:, :1] <= 0.5, torch.inf)


@pytest.mark.parametrize("function", [fails_at_times, has_gaps])
def test_rows_that_fail_are_dropped_and_counted(function: Any) -> None:
    source = simulated(function)
    x = source.simulate(THETA)[0]
    assert not x[1].isfinite().any()
    assert torch.equal(x[[0, 2]], THETA[[0, 2]])
    match = r"Dropped (\d+) of 200 .* from the prior \(\d+\.\d%\)"
    with pytest.warns(RoPEWarning, match=match) as caught:
        theta, x = source.from_prior(200)
    (warning,) = caught
    if function is not has_gaps:
        assert "ArithmeticError('no solution')" in str(warning.message)
    assert torch.equal(theta, x)
    assert (theta[:, 0] <= 0.5).all()
    assert source.num_dropped == 200 - len(theta) > 20


def test_a_failed_simulation_is_replaced_by_another_one_of_the_pair() -> None:
    theta = torch.stack([THETA, -THETA.flip(0)])  # 1 and 0 of 3 fail
    pairs = replace(pairs_at(theta[:, 0]), theta=theta)
    source = simulated(fails_at_times)
    with pytest.warns(RoPEWarning, match="Dropped 1 of 6"):
        at, x = draws(source, pairs, 1, itself)
    assert torch.equal(at, x)
    assert torch.equal(at[0], THETA[[0, 0, 2]])
    assert torch.equal(at[1], theta[1])
    with pytest.warns(RoPEWarning):
        assert source.at(theta, itself).isnan().sum() == 2
    with (
        pytest.raises(SimulationError, match=r"parameters \[\[0\.6.*\]\] failed"),
        pytest.warns(RoPEWarning, match="Dropped 4 of 12"),
    ):
        moments_at(source, THETA, 4)
    # Draws are repeated, all of them equally often.
    at, _ = draws(simulated(itself), pairs, 7, itself)
    assert torch.equal(at, theta.repeat(1, 3, 1))


def test_a_simulator_that_never_works_is_refused_with_its_error() -> None:
    def never_works(theta: Any) -> Any:
        raise ArithmeticError(f"no solution for {type(theta).__name__} {theta.shape}")

    with pytest.raises(SimulationError, match=r"no solution for ndarray \(2,\)") as it:
        simulated(never_works)
    assert isinstance(it.value.__cause__, ArithmeticError)
    with pytest.raises(SimulationError, match=r"shape \(2,\) .*; got \(3,\)"):
        simulated(lambda theta: np.zeros(3))


def fails_with_noise(theta: Any) -> Any:
    if theta[0] > 0.9:
        raise ArithmeticError("no solution")
    noise = np.random.standard_normal() + float(torch.randn(()))  # noqa: NPY002
    return [float(theta[0]) + noise, float(theta[1])]


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:Dropped")
def test_a_seed_gives_the_same_simulations_with_any_number_of_workers() -> None:
    drawn = []
    for num_workers in (1, 2):
        source = simulated(parallel(fails_with_noise, num_workers=num_workers))
        torch.manual_seed(0)
        drawn.append(source.from_prior(60))
        assert source.num_calls == 60
    assert all(map(torch.equal, *drawn))
    theta, x = drawn[0]
    assert len((x - theta)[:, 0].unique()) == len(theta) < 60
    with pytest.raises(SimulationError, match=r"All 1 sim.*ArithmeticError.*no sol"):
        source.at(torch.tensor([[[0.95, 0.1]]]), itself)
    # A batch is cut into pieces, and each has noise of its own.
    batched = simulated(parallel(lambda theta: theta + torch.randn_like(theta)))
    assert len(batched.simulate(THETA.repeat(100, 1))[0].unique(dim=0)) == 300


@pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")
def test_a_budget_is_simulated_once_and_then_used_as_stored_simulations_are() -> None:
    theta, x = gaussian.labelled(10)
    of_simulator: Any = {"simulator": gaussian.simulator}

    def made(**source: Any) -> RoPE:
        rope = RoPE(gaussian.posterior(), finetuner=QUICK, **source)
        return rope.append_calibration(theta, x)

    rope = made(**of_simulator, num_simulations=1200).train(seed=0)
    found = rope.build_posterior(x, seed=0, num_simulations=1200)
    assert rope.source.num_calls == 1200
    stored = made(simulations=rope.source.from_prior(1200)).train(seed=0)
    expected = stored.build_posterior(x, seed=0, num_simulations=1200)
    assert torch.allclose(found.weights.sort().values, expected.weights.sort().values)
    assert stored.source.num_calls == 0
    assert rope.build_posterior(x, num_simulations=1201).weights.shape == (10, 1200)
    without = made(**of_simulator).train()
    without.build_posterior(x)
    assert without.source.num_calls == 10 * 100 + 1000
    with pytest.raises(InvalidInputError, match="`num_simulations` with a simulator"):
        made(simulations=(theta, x), num_simulations=10)


MIXING = torch.tensor([[1.0, 0.6], [0.0, 0.8]])
NOISE = 0.25 * (MIXING.T @ MIXING).double()


def noisy(theta: Tensor) -> Tensor:
    """Curved in theta, with noise of covariance NOISE."""
    return signal(theta) + 0.5 * torch.randn(len(theta), 2) @ MIXING


def signal(theta: Tensor) -> Tensor:
    return torch.cat([3 * theta, theta.square()], dim=1)


def sometimes_nan(theta: Tensor) -> Tensor:
    return noisy(theta).where(torch.rand(len(theta), 1) < 0.7, torch.nan)


@pytest.mark.filterwarnings("ignore:Dropped")
def test_moments_of_a_simulator_are_those_of_finite_simulations() -> None:
    theta = torch.tensor([[-0.5], [0.8]])
    for function in (noisy, sometimes_nan):
        found = moments_at(simulated(function, dim=1), theta, 20_000)
        assert torch.allclose(found.mean, signal(theta).double(), atol=0.02)
        assert torch.allclose(found.covariance, NOISE.expand(2, 2, 2), atol=0.02)
    single = moments_at(simulated(noisy, dim=1), theta, 1)
    assert (single.covariance == 0).all()
    # Divided by three instead of two, it would be off by a third.
    few = moments_at(simulated(noisy, dim=1), torch.zeros(5000, 1), 3)
    assert torch.allclose(few.covariance.mean(dim=0), NOISE, atol=0.02)


def stored(theta: Tensor, x: Tensor, centre: float = 0.0) -> Source:
    return source_of(
        problems.box(theta.shape[1], centre - 1, centre + 1),
        simulator=None,
        simulations=(theta, x),
        like=x,
    )


def test_moments_of_stored_simulations_follow_the_slope_around_a_parameter() -> None:
    # A slope of 3: averaging around the edge of the box would miss its height.
    theta = 2 * torch.rand(20_000, 1) - 1
    at = torch.tensor([[-1.0], [0.3], [0.999]])
    expected = signal(at).double()
    for centre in (0.0, 1e4):
        source = stored(theta + centre, noisy(theta), centre)
        found = moments_at(source, at + centre, 100)
        # Fifty are around; at an edge the height is as uncertain as of twelve.
        assert torch.allclose(found.mean, expected, atol=0.45), centre
        assert torch.allclose(found.covariance.mean(dim=0), NOISE, atol=0.12), centre
        pairs = pairs_at(at + centre)
        mean = targets(source, pairs, 100, itself)
        assert torch.allclose(mean[1].double(), expected[1], atol=0.3), centre


def test_stored_simulations_at_parameters_are_like_those_of_the_simulator() -> None:
    """Regression adjustment keeps mean, slope and noise, of which 50 are near."""
    unit = torch.tensor([1.0, 100.0])
    theta = problems.box(2).sample((4000,))
    x = theta + 0.5 * torch.randn(4000, 2) @ MIXING
    source, at = Stored(theta * unit, x), 0.5 * problems.box(2).sample((20, 50))
    residual = source.at(at * unit, itself) - at
    assert float(residual.mean(dim=(0, 1)).abs().max()) < 0.1
    covariance = residual.double().reshape(-1, 2).T.cov()
    assert torch.allclose(covariance, NOISE, atol=0.05)
    # The mean at one parameter is the height of the plane through its neighbours.
    std = theta.std(dim=0)
    rows = torch.cdist(at[:1, 0] / std, theta / std)[0].argsort()[:50]
    design = torch.cat([torch.ones(50, 1), theta[rows] - at[0, 0]], dim=1)
    height = torch.linalg.lstsq(design, x[rows]).solution[0]
    found = source.at((at * unit)[:1, :1].expand(1, 50, 2), itself).mean(dim=1)
    assert torch.allclose(found[0], height, atol=1e-4)
