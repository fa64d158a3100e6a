"""Simulators of users, and what is found out about them before they are used."""

import itertools
import pickle
import threading
import traceback
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
from sbi_rope.errors import (
    InvalidInputError,
    RoPEWarning,
    SimulationError,
)
from sbi_rope.simulate import Simulator
from tests import gaussian, problems

QUICK = CalibrationFinetuner(max_num_epochs=2)
OWN_NOISE = torch.Generator().manual_seed(0)


def simulator_of(function: Callable[[Any], Any], *, length: int = 2) -> Simulator:
    return Simulator(
        function,
        problems.box(2),
        event_shape=torch.Size((length,)),
        like=torch.zeros(1),
    )


@pytest.mark.parametrize("length", [1, 2])
def test_a_simulator_may_squeeze_the_last_row_of_many(length: int) -> None:
    simulator = simulator_of(lambda theta: theta[:, :length].squeeze(), length=length)
    for count in (2, 1):
        theta = THETA[:count]
        assert torch.equal(simulator(theta), theta[:, :length])


@pytest.mark.parametrize("batched", [True, False])
def test_a_simulator_may_leave_out_the_dimension_of_a_single_channel(
    *, batched: bool
) -> None:
    """An image of one channel is (1, 4, 5) for NPE, and (4, 5) for most people."""

    def image(theta: Tensor) -> Tensor:
        if not batched and theta.ndim > 1:
            raise ValueError("one theta at a time")
        return theta[..., :1, None] + torch.arange(20.0).reshape(4, 5)

    simulator = Simulator(
        image,
        problems.box(2),
        event_shape=torch.Size((1, 4, 5)),
        like=torch.zeros(1),
    )
    assert simulator.is_batched == batched
    for count in (2, 1):
        theta = THETA[:count]
        expected = theta[:, 0, None, None, None] + torch.arange(20.0).reshape(4, 5)
        assert torch.equal(simulator(theta), expected)


def test_noise_that_no_seed_repeats_is_warned_of() -> None:
    for function in (
        has_noise_of_its_own,
        lambda theta: theta.numpy() + np.random.default_rng().normal(size=theta.shape),
    ):
        with pytest.warns(RoPEWarning, match=r"no `seed` repeats.*default_rng\(np"):
            assert simulator_of(function).is_batched
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulator_of(lambda theta: theta + torch.randn_like(theta))


def mixes(theta: Tensor) -> Tensor:
    return theta * theta.norm() + 0.1 * torch.randn_like(theta)


def mixes_with_noise_of_its_own(theta: Tensor) -> Tensor:
    noise = torch.randn(theta.shape, generator=OWN_NOISE)
    return theta * theta.norm() + 0.1 * noise


def centres(theta: Tensor) -> Tensor:
    return theta - theta.mean()


@pytest.mark.medium
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
        with pytest.raises(SimulationError, match="that does not hold plain numbers"):
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


# --- tensors and arrays, batches and single parameters ---

THETA = torch.tensor([[0.3, 0.4], [0.6, -0.8], [-0.1, 0.9]])

RETURNS: dict[str, Callable[[Any], Any]] = {
    "a tensor": torch.as_tensor,
    "an array": np.asarray,
    "a list": lambda x: x.tolist(),
    "a tuple": lambda x: tuple(x.tolist()),
    "a list of parts": list,
}


@pytest.mark.parametrize("returns", RETURNS)
def test_simulators_take_and_return_what_their_authors_prefer(returns: str) -> None:
    for kind, batched in itertools.product((Tensor, np.ndarray), (True, False)):

        def doubles(theta: Any) -> Any:
            assert isinstance(theta, kind)  # noqa: B023
            assert theta.ndim == 1 + batched  # noqa: B023
            return RETURNS[returns](2 * theta)

        simulator = simulator_of(doubles)
        assert simulator.is_batched is batched
        x = simulator(THETA)
        assert x.dtype == torch.float32
        assert torch.equal(x, 2 * THETA)


def test_one_number_needs_no_dimension_of_its_own() -> None:
    functions: list[Callable[[Any], Any]] = [
        lambda theta: theta.sum(dim=-1),
        lambda theta: theta.sum(axis=-1).astype(np.float32),
        lambda theta: float(theta[0] + theta[1]),
        lambda theta: np.float64(theta[0]) + float(theta[1]),
        lambda theta: [theta[0] + theta[1]],
    ]
    for function in functions:
        x = simulator_of(function, length=1)(THETA)
        assert x.shape == (3, 1)
        assert torch.allclose(x[:, 0], THETA.sum(dim=1))


def test_arrays_hold_float64_and_are_copies() -> None:
    def changes(theta: Any) -> Any:
        assert theta.dtype == np.float64
        x = theta.copy()
        theta[:] = 0
        return x

    theta = THETA.clone()
    assert torch.equal(simulator_of(changes)(theta), THETA)
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
        rope.embed(THETA, num_simulations=20, seed=seed, show_progress_bars=False)
        for seed in (1, 1)
    )
    assert torch.equal(one.simulated, two.simulated)


def test_a_simulator_that_makes_arrays_of_tensors_gets_arrays() -> None:
    seen = []

    def both(theta: Any) -> Any:
        seen.append(type(theta))
        return np.asarray(theta)

    simulator = simulator_of(both)
    seen.clear()
    simulator(THETA)
    assert seen == [np.ndarray]


def test_noise_of_arrays_that_a_batch_would_share_is_drawn_for_each_theta() -> None:
    def noisy(theta: Any) -> Any:
        return theta.astype(float) + np.random.standard_normal(2)  # noqa: NPY002

    with pytest.warns(RoPEWarning, match="called with one theta at a time"):
        simulator = simulator_of(noisy)
    noise = simulator(THETA) - THETA
    assert len(noise.unique(dim=0)) == 3


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


def test_rows_for_which_the_simulator_raises_are_nan_counted_and_named() -> None:
    for function in (fails_at_times, fails_in_batches):
        simulator = simulator_of(function)
        assert simulator.is_batched is (function is fails_in_batches)
        with pytest.warns(
            RoPEWarning,
            match=r"for 1 of 3 .*row 1, theta \[0\.6.*ArithmeticError: no solution",
        ):
            x = simulator(THETA)
        assert x[1].isnan().all()
        assert torch.equal(x[[0, 2]], THETA[[0, 2]])
        with pytest.warns(
            RoPEWarning, match=r"Dropped (\d+) of 200 .* For \1 of them .* raised"
        ) as caught:
            theta, x = simulator.from_prior(200, 200, lambda x: x, progress=False)
        assert len(caught) == 1
        assert torch.equal(theta, x)
        assert (theta[:, 0] <= 0.5).all()
        assert simulator.num_dropped == 200 - len(theta) > 20


def test_a_simulator_that_fails_at_the_first_parameters_is_recognised() -> None:
    calls = 0

    def fails_first(theta: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls < 9:
            raise ArithmeticError("no solution")
        return [float(theta[0]), float(theta[1])]

    assert torch.equal(simulator_of(fails_first)(THETA), THETA)


def fails_mostly(theta: Any) -> Any:
    if theta[0] > -0.5:
        raise ArithmeticError("no solution")
    return np.array([theta[0], theta[1]])


def is_told_once(error: BaseException) -> bool:
    """Whether a traceback holds that of the user's own error, and only once."""
    text = "".join(traceback.format_exception(error))
    nested = "During handling of the above" in text
    return text.count('raise ArithmeticError("no solution")') == 1 and not nested


def test_a_simulator_that_raises_for_most_parameters_is_refused() -> None:
    expected = r"raised for 1\d\d of 200, first in row \d, theta .*: Arithm.*: no sol"
    with pytest.raises(SimulationError, match=expected) as caught:
        simulator_of(fails_mostly).from_prior(200, 200, lambda x: x, progress=False)
    assert is_told_once(caught.value)
    assert "return NaN where a simulation cannot be made" in str(caught.value)


def test_a_theta_for_which_the_simulator_always_raises_is_refused() -> None:
    simulator = simulator_of(fails_at_times)
    expected = r"parameters \[\[0\.6.*1 pairs.* For 4 of them .* no solution"
    with pytest.raises(SimulationError, match=expected) as caught:
        simulator.moments(THETA, 4, lambda x: x, progress=False)
    assert is_told_once(caught.value)
    many = torch.cat([THETA[:1].repeat(17, 1), THETA])
    with pytest.raises(SimulationError, match="raised, first in row 18, theta"):
        simulator.moments(many, 1, lambda x: x, progress=False)


def never_works(theta: Any) -> Any:
    if isinstance(theta, Tensor):
        theta = theta.numpy()
    _first, _second = theta
    raise ArithmeticError("no solution")


def test_a_simulator_that_never_works_is_refused_with_all_that_was_tried() -> None:
    with pytest.raises(SimulationError, match="return one of these, with NaN") as found:
        simulator_of(never_works)
    assert is_told_once(found.value)
    text = str(found.value)
    for tried in ("a tensor (3, 2): ValueError", "an array (2,): ArithmeticError: no"):
        assert tried in text


def test_simulations_of_another_shape_are_refused_with_the_theta() -> None:
    def stops_early(theta: Any) -> Any:
        return np.zeros(2 if theta[0] < 0.5 else 1)

    def stops_early_in_batches(theta: Tensor) -> Tensor:
        return torch.zeros(len(theta), 2 if (theta[:, 0] < 0.7).all() else 1)

    simulator = simulator_of(stops_early)
    expected = r"shape \(2,\) for theta .*\[0\.6.*array of shape \(1,\).* return NaN"
    with pytest.raises(SimulationError, match=expected):
        simulator(THETA)
    simulator = simulator_of(stops_early_in_batches)
    with pytest.raises(SimulationError, match=r"shape \(3, 2\) .*shape \(3, 1\)"):
        simulator(THETA + 0.2)


# --- worker processes ---


def sleepless(theta: Any) -> Any:
    if theta[0] > 0.9:
        raise ArithmeticError("no solution")
    noise = np.random.standard_normal() + float(torch.randn(()))  # noqa: NPY002
    return [float(theta[0]) + noise, float(theta[1])]


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:Dropped")
def test_a_seed_gives_the_same_simulations_with_any_number_of_workers() -> None:
    drawn = []
    for num_workers in (1, 2):
        simulator = simulator_of(parallel(sleepless, num_workers=num_workers))
        probed = simulator.num_calls
        torch.manual_seed(0)
        drawn.append(simulator.from_prior(60, 60, lambda x: x, progress=False))
        assert simulator.num_calls == probed + 60
    for ours, theirs in zip(*drawn, strict=True):
        assert torch.equal(ours, theirs)
    theta, x = drawn[0]
    assert len((x - theta)[:, 0].unique()) == len(theta) < 60
    # The error of a worker comes with its traceback, as text.
    bad = torch.cat([THETA, torch.tensor([[0.95, 0.1]]).repeat(4, 1)])
    expected = r"4 of 7, first in row 3, .*no solution"
    with pytest.raises(SimulationError, match=expected) as found:
        simulator(bad)
    assert 'raise ArithmeticError("no solution")' in str(found.value.__cause__)
    # A batch is cut into pieces, and each has noise of its own.
    batched = simulator_of(parallel(gaussian.simulator, num_workers=2))
    assert batched.is_batched
    assert len(batched(THETA.repeat(100, 1)).unique(dim=0)) == 300


def test_noise_that_all_workers_would_repeat_is_refused() -> None:
    own = np.random.default_rng(0)

    def repeats(theta: Any) -> Any:
        return [float(theta[0]) + own.standard_normal(), float(theta[1])]

    with pytest.raises(SimulationError, match="would repeat the same noise"):
        simulator_of(parallel(repeats, num_workers=2))

    def unseeded(theta: Any) -> Any:
        noise = np.random.default_rng().standard_normal()
        return [float(theta[0]) + noise, float(theta[1])]

    for num_workers in (1, 2):
        with pytest.warns(RoPEWarning, match="cannot be repeated"):
            simulator_of(parallel(unseeded, num_workers=num_workers))


def test_a_simulator_that_cannot_be_sent_to_workers_is_refused_at_once() -> None:
    lock = threading.Lock()

    def holds(theta: Tensor) -> Tensor:
        with lock:
            return theta.clone()

    with pytest.raises(SimulationError, match=r"sent to worker.*lock.* open file"):
        simulator_of(parallel(holds, num_workers=2))
    assert simulator_of(parallel(holds, num_workers=1)).is_batched


def test_what_cannot_be_called_in_parallel_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`simulator` to be callable"):
        parallel(3)  # type: ignore[arg-type]
    for num_workers in (0, -1, 1.5, 10**6):
        with pytest.raises(InvalidInputError, match="`num_workers`"):
            parallel(decays, num_workers=num_workers)  # type: ignore[arg-type]


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
    sent = pickle.loads(pickle.dumps(parallel(gaussian.simulator, num_workers=3)))
    assert sent.num_workers == 3
    assert sent(theta).shape == theta.shape


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
    probed = before.num_simulator_calls
    before.append_calibration(theta, x).train(show_progress_bars=False)
    assert before.num_simulator_calls == probed + 1000
    before.build_posterior(x, show_progress_bars=False)
    assert before.num_simulator_calls == probed + 2000


@pytest.mark.filterwarnings("ignore:Coupling a batch")
def test_a_simulator_with_a_number_of_simulations_is_called_so_often_in_all() -> None:
    theta, x = gaussian.labelled(10)
    count, rows = counted(gaussian.simulator)
    rope = RoPE(
        gaussian.posterior(), simulator=count, num_simulations=1200, finetuner=QUICK
    )
    probed = sum(rows)
    rope.append_calibration(theta, x).train(seed=0, show_progress_bars=False)
    found = rope.build_posterior(x, seed=0, show_progress_bars=False)
    assert sum(rows) == rope.num_simulator_calls == probed + 1200
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


@pytest.mark.filterwarnings("ignore:Only 200 simulations")
def test_the_noise_of_a_number_of_simulations_does_not_repeat_their_parameters() -> (
    None
):
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
    with pytest.raises(InvalidInputError, match="`num_simulations` to be an integer"):
        RoPE(gaussian.posterior(), simulator=gaussian.simulator, num_simulations=0)


def test_few_simulations_are_warned_about() -> None:
    theta, x = gaussian.labelled(1000)
    with pytest.warns(RoPEWarning, match=r"Only 999 .* are then less accurate"):
        RoPE(gaussian.posterior(), simulations=(theta[1:], x[1:]))
    with pytest.warns(RoPEWarning, match="Only 999 simulations"):
        RoPE(gaussian.posterior(), simulator=gaussian.simulator, num_simulations=999)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RoPE(gaussian.posterior(), simulations=(theta, x))


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
    monkeypatch.setattr("sbi_rope._simulator.source.DELAY", 0.0)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.embed(THETA)
    assert "Calling the simulator 1,000 times: 100%" in terminal.readouterr().err
