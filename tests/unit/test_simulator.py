"""Simulators of users: how they are called, where they fail, how often they run."""

import itertools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import odeint
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE, parallel
from sbi_rope.discrepancy import DiscrepancyNPE
from sbi_rope.errors import InvalidInputError, RoPEWarning, SimulationError
from sbi_rope.simulate import Simulator
from tests import gaussian, problems

QUICK = CalibrationFinetuner(max_num_epochs=2)
THETA = torch.tensor([[0.3, 0.4], [0.6, -0.8], [-0.1, 0.9]])


def simulator_of(function: Callable[[Any], Any], *shape: int) -> Simulator:
    return Simulator(
        function,
        problems.box(2),
        event_shape=torch.Size(shape or (2,)),
        like=torch.zeros(1),
    )


# --- tensors and arrays, batches and single parameters ---

RETURNS: dict[str, Callable[[Any], Any]] = {
    "a tensor": torch.as_tensor,
    "an array": np.asarray,
    "a list": lambda x: x.tolist(),
    "a list of parts": list,
}


def test_a_simulator_that_draws_noise_for_one_theta_is_called_row_by_row() -> None:
    """It takes a batch, but all rows would have the same noise."""
    for draw in (torch.randn, lambda d: np.random.standard_normal(d)):  # noqa: NPY002
        x = simulator_of(lambda theta: theta + draw(2))(torch.zeros(50, 2))  # noqa: B023
        assert len(x.unique(dim=0)) == 50
    calls = []
    simulator_of(lambda theta: calls.append(theta.ndim) or 2 * theta)(THETA)
    assert set(calls) == {2}  # what has no noise is called in batches


@pytest.mark.parametrize("returns", RETURNS)
def test_simulators_take_and_return_what_their_authors_prefer(returns: str) -> None:
    for kind, ndim in itertools.product((Tensor, np.ndarray), (1, 2)):

        def doubles(theta: Any) -> Any:
            assert isinstance(theta, kind)  # noqa: B023
            assert theta.ndim == ndim  # noqa: B023
            return RETURNS[returns](2 * theta)

        x = simulator_of(doubles)(THETA)
        assert x.dtype == torch.float32
        assert torch.equal(x, 2 * THETA)


def test_batches_come_first_and_arrays_for_those_who_make_arrays() -> None:
    seen = []

    def both(theta: Any) -> Any:
        seen.append((type(theta), theta.shape))
        return np.asarray(theta)

    def of_tensors(theta: Any) -> Any:
        seen.append((type(theta), theta.shape))
        return torch.as_tensor(theta)

    for function, kind in ((both, np.ndarray), (of_tensors, Tensor)):
        simulator = simulator_of(function)
        seen.clear()
        simulator(THETA)
        assert seen == [(kind, (3, 2))]


@pytest.mark.parametrize("shape", [(1,), (2,), (1, 4, 5)])
def test_dimensions_of_size_one_may_be_missing(shape: tuple[int, ...]) -> None:
    numbers = torch.arange(torch.Size(shape).numel()).reshape(shape)

    def batched(theta: Tensor) -> Tensor:
        return (theta[:, 0].reshape(-1, *[1] * len(shape)) + numbers).squeeze()

    def single(theta: Tensor) -> Tensor:
        assert theta.ndim == 1
        return (theta[0] + numbers).squeeze()

    for function in (batched, single):
        simulator = simulator_of(function, *shape)
        for count in (3, 1):
            expected = torch.stack([row[0] + numbers for row in THETA[:count]])
            assert torch.equal(simulator(THETA[:count]), expected)


def test_a_simulator_may_return_numbers() -> None:
    for function in (
        lambda theta: float(theta[0] + theta[1]),
        lambda theta: [theta[0] + theta[1]],
        lambda theta: theta.sum(axis=-1).astype(np.float32),
    ):
        x = simulator_of(function, 1)(THETA)
        assert torch.allclose(x, THETA.sum(dim=1, keepdim=True))


def test_arguments_and_results_are_copies() -> None:
    buffer = torch.zeros(2)

    def reuses(theta: Tensor) -> Tensor:
        assert theta.ndim == 1
        return buffer.copy_(theta)

    def changes(theta: Tensor) -> Tensor:
        x = theta.clone()
        theta.mul_(0)
        return x

    def changes_array(theta: Any) -> Any:
        assert theta.dtype == np.float64  # as solvers of SciPy expect
        x = theta.copy()
        theta[:] = 0
        return x

    theta = THETA.clone()
    for function in (reuses, changes, changes_array):
        assert torch.equal(simulator_of(function)(theta), THETA)
    assert torch.equal(theta, THETA)


def decays(theta: Any) -> Any:
    """Solve an ordinary differential equation, with noise."""
    times = np.linspace(0.0, 1.0, 2)
    path = odeint(lambda y, t: theta[1] - theta[0] * y, 1.0, times)
    return path[:, 0] + 0.01 * np.random.standard_normal(2)  # noqa: NPY002


def test_a_solver_of_scipy_gets_arrays_and_its_noise_follows_the_seed() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rope = RoPE(gaussian.posterior(), simulator=decays)
    one, two = (
        rope.embed(THETA, num_simulations=20, seed=1, show_progress_bars=False)
        for _ in range(2)
    )
    assert torch.equal(one.simulated, two.simulated)


# --- simulators that fail ---


def fails_at_times(theta: Any) -> Any:
    """A simulator of one theta without a solution at some."""
    if theta[0] > 0.5:
        raise ArithmeticError("no solution")
    return np.array([theta[0], theta[1]])


def fails_in_batches(theta: Tensor) -> Tensor:
    if (theta[:, 0] > 0.5).any():
        raise ArithmeticError("no solution")
    return theta.clone()


def is_short_at_times(theta: Any) -> Any:
    return np.array([theta[0], theta[1]][: 2 if theta[0] <= 0.5 else 1])


def has_gaps(theta: Tensor) -> Tensor:
    return theta.where(theta[:, :1] <= 0.5, torch.inf)


@pytest.mark.parametrize(
    "function", [fails_at_times, fails_in_batches, is_short_at_times, has_gaps]
)
def test_rows_that_fail_are_dropped_and_counted(function: Any) -> None:
    simulator = simulator_of(function)
    x = simulator(THETA)
    assert not x[1].isfinite().any()
    assert torch.equal(x[[0, 2]], THETA[[0, 2]])
    with pytest.warns(
        RoPEWarning, match=r"Dropped (\d+) of 200 .* from the prior \(\d+\.\d%\)"
    ) as caught:
        theta, x = simulator.from_prior(200, 200, lambda x: x, progress=False)
    assert len(caught) == 1
    if "fails" in function.__name__:
        assert "ArithmeticError('no solution')" in str(caught[0].message)
    assert torch.equal(theta, x)
    assert (theta[:, 0] <= 0.5).all()
    assert simulator.num_dropped == 200 - len(theta) > 20


def test_simulations_that_replace_failed_ones_have_their_own_parameters() -> None:
    simulator = simulator_of(fails_at_times)
    theta = torch.stack([THETA, -THETA.flip(0)])  # 1 and 0 of 3 fail
    with pytest.warns(RoPEWarning, match="Dropped 1 of 6"):
        at, x = simulator.once_at(theta, lambda x: x, progress=False)
    assert torch.equal(at, x)
    assert torch.equal(at[1], theta[1])
    assert torch.equal(at[0], THETA[[0, 0, 2]])


def test_a_simulator_that_fails_at_the_first_parameters_is_recognised() -> None:
    calls = 0

    def fails_first(theta: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls < 9:
            raise ArithmeticError("no solution")
        return [float(theta[0]), float(theta[1])]

    assert torch.equal(simulator_of(fails_first)(THETA), THETA)


def test_a_simulator_that_never_works_is_refused_with_its_last_error() -> None:
    def never_works(theta: Any) -> Any:
        raise ArithmeticError(f"no solution for {type(theta).__name__} {theta.shape}")

    with pytest.raises(SimulationError, match=r"no solution for ndarray \(2,\)") as it:
        simulator_of(never_works)
    assert isinstance(it.value.__cause__, ArithmeticError)
    with pytest.raises(SimulationError, match=r"shape \(2,\) .*; got \(3,\)"):
        simulator_of(lambda theta: np.zeros(3))


def test_parameters_at_which_all_simulations_fail_are_refused() -> None:
    simulator = simulator_of(fails_at_times)
    with pytest.raises(SimulationError, match=r"parameters \[\[0\.6.*\]\] failed"):  # noqa: SIM117
        with pytest.warns(RoPEWarning, match="Dropped 4 of 12"):
            simulator.moments(THETA, 4, lambda x: x, progress=False)
    with pytest.raises(SimulationError, match="All 4 simulations") as caught:
        simulator.moments(THETA[1:2], 4, lambda x: x, progress=False)
    assert isinstance(caught.value.__cause__, ArithmeticError)


# --- worker processes ---


class TwoArgumentsError(Exception):
    """An error that cannot be sent to another process."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first} {second}")


def fails_with_noise(theta: Any) -> Any:
    if theta[0] > 0.9:
        raise TwoArgumentsError("no", "solution")
    noise = np.random.standard_normal() + float(torch.randn(()))  # noqa: NPY002
    return [float(theta[0]) + noise, float(theta[1])]


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:Dropped")
def test_a_seed_gives_the_same_simulations_with_any_number_of_workers() -> None:
    drawn = []
    for num_workers in (1, 2):
        simulator = simulator_of(parallel(fails_with_noise, num_workers=num_workers))
        tried = simulator.num_calls
        torch.manual_seed(0)
        drawn.append(simulator.from_prior(60, 60, lambda x: x, progress=False))
        assert simulator.num_calls == tried + 60
    for ours, theirs in zip(*drawn, strict=True):
        assert torch.equal(ours, theirs)
    theta, x = drawn[0]
    assert len((x - theta)[:, 0].unique()) == len(theta) < 60
    bad = torch.tensor([[[0.95, 0.1]]])
    with pytest.raises(SimulationError, match="TwoArgumentsError: no solution"):
        simulator.once_at(bad, lambda x: x, progress=False)
    # A batch is cut into pieces, and each has noise of its own.
    batched = simulator_of(parallel(lambda theta: theta + torch.randn_like(theta)))
    assert len(batched(THETA.repeat(100, 1)).unique(dim=0)) == 300


def test_what_cannot_be_called_in_parallel_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`simulator`"):
        parallel(3)  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="`num_workers`"):
        parallel(decays, num_workers=0)


def test_methods_take_a_simulator_that_runs_in_parallel() -> None:
    theta, x = gaussian.labelled(10)
    method = DiscrepancyNPE.from_posterior(
        gaussian.posterior(),
        simulator=parallel(lambda theta: theta.numpy() + 0.1, num_workers=1),
        num_simulations=50,
        simulations_per_pair=2,
    ).append_calibration(theta, x)
    report = method.report(show_progress_bars=False)
    assert len(report.summaries) == 2


# --- how often the simulator is called ---


def counted(function: Callable[[Any], Any]) -> tuple[Callable[[Any], Any], list[int]]:
    """Return a simulator, and the list of the numbers of rows it is called with."""
    rows: list[int] = []

    def count(theta: Any) -> Any:
        rows.append(len(theta) if theta.ndim == 2 else 1)
        return function(theta)

    return count, rows


@pytest.mark.filterwarnings("ignore:Coupling a batch")
def test_calls_of_the_simulator_are_counted_from_the_first_on() -> None:
    theta, x = gaussian.labelled(10)
    for function in (gaussian.simulator, fails_in_batches):
        count, rows = counted(function)
        rope = RoPE(gaussian.posterior(), simulator=count)
        assert 0 < rope.num_simulator_calls == sum(rows) < 40
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rope.embed(x, num_simulations=30, show_progress_bars=False)
        assert rope.num_simulator_calls == sum(rows)
    before = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=QUICK)
    tried = before.num_simulator_calls
    before.append_calibration(theta, x).train(show_progress_bars=False)
    assert before.num_simulator_calls == tried + 1000
    before.build_posterior(x, show_progress_bars=False)
    assert before.num_simulator_calls == tried + 2000


@pytest.mark.filterwarnings("ignore:Coupling a batch")
def test_a_simulator_with_a_number_of_simulations_is_called_so_often_in_all() -> None:
    theta, x = gaussian.labelled(10)
    count, rows = counted(gaussian.simulator)
    rope = RoPE(
        gaussian.posterior(), simulator=count, num_simulations=1200, finetuner=QUICK
    )
    tried = sum(rows)
    rope.append_calibration(theta, x).train(seed=0, show_progress_bars=False)
    found = rope.build_posterior(x, seed=0, show_progress_bars=False)
    assert sum(rows) == rope.num_simulator_calls == tried + 1200
    # The simulations are used as stored ones are.
    stored = RoPE(
        gaussian.posterior(),
        simulations=rope.source.kept(1200, progress=False),
        finetuner=QUICK,
    )
    stored.append_calibration(theta, x).train(seed=0, show_progress_bars=False)
    again = rope.build_posterior(x, seed=0, num_simulations=1200)
    expected = stored.build_posterior(x, seed=0, num_simulations=1200)
    assert torch.allclose(again.weights.sort().values, expected.weights.sort().values)
    assert found.weights.shape == (10, 1000)
    assert stored.num_simulator_calls == 0
    with pytest.raises(InvalidInputError, match="at most 1200"):
        rope.build_posterior(x, num_simulations=1201)


def test_simulations_that_failed_are_not_taken_for_those_of_another_prior() -> None:
    def fails_where_large(theta: Tensor) -> Tensor:
        failed = (theta[:, :1] > 0.0).expand(-1, 2)
        return gaussian.simulator(theta).masked_fill(failed, torch.nan)

    rope = RoPE(gaussian.posterior(), simulator=fails_where_large, num_simulations=1200)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rope.embed(gaussian.labelled(10)[1], show_progress_bars=False)
    texts = [str(one.message) for one in caught]
    assert any("of 1200 simulations from the prior" in text for text in texts)
    assert not any("distributed like the prior" in text for text in texts)


def test_the_noise_of_limited_simulations_does_not_repeat_their_parameters() -> None:
    def simulator(theta: Tensor) -> Tensor:
        return theta + torch.randn(theta.shape)  # from which the prior draws, too

    rope = RoPE(gaussian.posterior(), simulator=simulator, num_simulations=200)
    theta, x = rope.source.kept(200, progress=False)
    both = torch.cat([theta, x - theta], dim=1)
    correlation = both.T.corrcoef()[:2, 2:]
    assert correlation.abs().max() < 0.3  # four standard errors


def test_a_number_of_simulations_needs_a_simulator() -> None:
    pairs = gaussian.labelled(1000)
    with pytest.raises(InvalidInputError, match="`num_simulations` with a simulator"):
        RoPE(gaussian.posterior(), simulations=pairs, num_simulations=1000)


@pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")
@pytest.mark.parametrize("num_workers", [None, 1])
def test_simulations_that_were_interrupted_go_on_where_they_were(
    num_workers: int | None,
) -> None:
    calls, broken = [], []

    def one(theta: Tensor) -> Tensor:
        assert theta.shape == (2,)
        if len(calls) in broken:
            raise KeyboardInterrupt
        calls.append(theta)
        return theta + torch.randn(2)

    simulator = one if num_workers is None else parallel(one, num_workers=num_workers)

    def rope() -> RoPE:
        made = RoPE(gaussian.posterior(), simulator=simulator, num_simulations=350)
        return made.append_calibration(*pairs)

    pairs = gaussian.labelled(5)
    undisturbed = rope().draw_targets(1)
    interrupted = rope()
    # Within the third part, which has ten simulations, or a hundred of processes.
    done, size = (20, 10) if num_workers is None else (200, 100)
    broken.append(len(calls) + done + size // 2)
    with pytest.raises(KeyboardInterrupt):
        interrupted.draw_targets(1)
    broken.clear()
    before = len(calls)
    assert torch.equal(interrupted.draw_targets(1), undisturbed)
    assert len(calls) - before == 350 - done
    interrupted.draw_targets(1)
    assert len(calls) - before == 350 - done


def test_the_bar_of_a_slow_simulator_says_how_often_it_is_called(
    terminal: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sbi_rope.simulate.DELAY", 0.0)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.embed(THETA)
    assert "Calling the simulator 1,000 times: 100%" in terminal.readouterr().err
