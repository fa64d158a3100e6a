"""What every task promises of its prior, its simulator and its network.

Its labelled sets are in ``test_task_sets.py``, bad arguments of the simulators in
``tests/integration/test_bad_inputs.py``.
"""

import copy
import math
import pickle
import warnings

import pytest
import torch
from sbi.utils import within_support
from sbi.utils.user_input_checks import process_prior

from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS, inside_region
from tests.tasks import as_many, make, same_rows

# Priors that reach everywhere.
UNBOUNDED = {"linear_gaussian"}
STANDARD = [(name, None) for name in sorted(TASKS)]
# Variants with a prior of their own.
OTHER_PRIORS = [
    ("light_tunnel_sensors", "strong_colours"),
    ("light_tunnel_sensors", "strong_angles"),
]
TASK = pytest.mark.parametrize("kind", STANDARD, ids=str)
PRIOR = pytest.mark.parametrize("kind", [*STANDARD, *OTHER_PRIORS], ids=str)


@pytest.fixture
def task(kind: tuple[str, str | None]) -> Task:
    return make(kind[0], variant=kind[1])


@TASK
def test_the_description_has_an_entry_for_every_parameter_and_variant(
    task: Task,
) -> None:
    assert TASKS[task.name] is type(task)
    assert len(task.parameter_names) == len(task.parameter_units) == task.theta_dim
    assert len(set(task.parameter_names)) == task.theta_dim
    assert task.prior_std.shape == (task.theta_dim,)
    assert len(task.x_names) in (0, *task.x_shape)
    assert set(COMMON_VARIANTS) <= set(task.variants)
    assert set(task.shifted_region) <= set(task.parameter_names)


@PRIOR
def test_sbi_takes_the_prior_and_its_float32_draws_as_they_are(task: Task) -> None:
    before = torch.get_rng_state()
    prior = task.get_prior()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        processed, theta_dim, returns_numpy = process_prior(prior)
    assert processed is prior
    assert (theta_dim, returns_numpy) == (task.theta_dim, False)
    torch.set_rng_state(before)
    assert task.get_prior() is not prior
    assert torch.equal(before, torch.get_rng_state())
    theta = prior.sample(torch.Size((1000,)))
    assert theta.shape == (1000, task.theta_dim)
    assert within_support(prior, theta).all()
    log_prob = prior.log_prob(theta)
    assert torch.isfinite(log_prob).all()
    for copied in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        torch.testing.assert_close(copied.log_prob(theta), log_prob)
    torch.set_default_dtype(torch.float64)
    try:
        assert task.get_prior().sample().dtype == theta.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.medium
@PRIOR
def test_density_spread_and_quantiles_of_the_prior_are_those_of_its_draws(
    task: Task,
) -> None:
    prior = process_prior(task.get_prior())[0]
    draws = prior.sample((50_000,))
    torch.testing.assert_close(draws.std(dim=0), task.prior_std, rtol=0.02, atol=0.0)
    inside = inside_region(draws, task.parameter_names, task.shifted_region)
    assert 0.05 < inside.mean() < 0.75
    # The quantiles are uniform. Kolmogorov's distance is above 2.5 / sqrt(n) once in a
    # hundred thousand.
    quantiles = task.prior_quantiles(draws)
    assert quantiles.shape == draws.shape
    steps = torch.arange(1, 50_001) / 50_000
    distance = (quantiles.sort(dim=0).values - steps[:, None]).abs().max()
    assert distance < 2.5 / 50_000**0.5
    # The density integrates to one over a box around all draws.
    low, high = draws.min(dim=0).values, draws.max(dim=0).values
    margin = 0.05 * (high - low)
    low, high = low - margin, high + margin
    box = low + (high - low) * torch.rand(200_000, task.theta_dim)
    mass = prior.log_prob(box).double().exp().mean() * (high - low).double().prod()
    assert mass == pytest.approx(1.0, abs=0.015)
    if task.name not in UNBOUNDED:
        for outside in (draws - 1.1 * (high - low), draws + 1.1 * (high - low)):
            assert not within_support(prior, outside).any()
            assert (prior.log_prob(outside) == -torch.inf).all()


ALPHA = [0.5, 0.1]  # with the density of Malus' law at uniform angles
ANALYTIC: dict[str, tuple[list[list[float]], list[float]]] = {
    "cs": ([[850.0, 11.5, 15.0]], [-math.log(1300 * 17 * 10)]),
    "light_tunnel": (
        [[0.0, 254.0, 100.0, ALPHA[0]], [1.0, 2.0, 3.0, ALPHA[1]]],
        [-3 * math.log(255) - math.log(math.pi * (a - a * a) ** 0.5) for a in ALPHA],
    ),
    "light_tunnel_sensors": (
        [[0.0, 85.0, 42.0, 0.0], [0.0, 85.0, 42.0, 30.0]],
        [-3 * math.log(86) + math.log(2 * (40 - d) / 1600) for d in (0, 30)],
    ),
    "pendulum": ([[0.1, 1.0]], [-math.log(28.5)]),
    "sir": ([[0.4, 0.1]], [math.log(8)]),
    # Torch's uniform laws exclude their upper end, where recorded parameters lie.
    "wind_tunnel": ([[22.5], [45.0]], [-math.log(45)] * 2),
}


def test_the_density_of_the_prior_is_that_of_the_paper() -> None:
    for name, (theta, expected) in ANALYTIC.items():
        log_prob = make(name).get_prior().log_prob(torch.tensor(theta))
        assert log_prob.tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.medium
@TASK
def test_the_simulator_returns_finite_batches_of_any_size(task: Task) -> None:
    simulator, theta = task.get_simulator(), task.get_prior().sample((1000,))
    for n in (0, 1, 1000):
        x = simulator(theta[:n])
        assert x.shape == (n, *task.x_shape)
        assert x.dtype == torch.float32
        assert torch.isfinite(x).all()
    assert simulator(theta[:2].double()).dtype == torch.float64


@TASK
def test_the_noise_of_the_simulator_follows_the_global_seed(task: Task) -> None:
    theta = task.get_prior().sample((1,)).expand(2, -1)
    simulator = task.get_simulator()
    draws = []
    for some, seed in (
        (simulator, 1),
        (pickle.loads(pickle.dumps(simulator)), 1),
        (simulator, 2),
    ):
        torch.manual_seed(seed)
        draws.append(some(theta))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert not torch.equal(*draws[0])


@pytest.mark.medium
@TASK
def test_embedding_nets_are_new_and_use_all_of_their_parameters(task: Task) -> None:
    x = task.get_simulator()(task.get_prior().sample((50,)))
    sizes = []
    for light in (True, False):
        net, other = (task.get_embedding_net(light=light) for _ in range(2))
        statistics = net(x)
        assert (statistics.ndim, len(statistics)) == (2, 50)
        assert not torch.equal(statistics, other(x))
        statistics.square().sum().backward()
        for name, parameter in net.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name
        sizes.append(sum(p.numel() for p in net.parameters()))
    assert sizes[0] <= sizes[1]


@pytest.mark.medium
@TASK
def test_simulations_to_train_on_are_a_prefix_of_more_and_share_nothing_with_the_sets(
    task: Task,
) -> None:
    theta, x = task.get_simulations(150, seed=1)
    assert x.shape == (150, *task.x_shape)
    assert within_support(task.get_prior(), theta).all()
    few = task.get_simulations(7, seed=1)
    assert torch.equal(few[0], theta[:7])
    assert torch.equal(few[1], x[:7])
    for part in ("calibration", "test"):
        n = as_many(100, task, part, seed=1)
        observed, _ = getattr(task, f"get_{part}_set")(n, seed=1)
        assert same_rows(theta, observed) == 0
    assert same_rows(x, task.get_simulations(150, seed=2)[1]) == 0
