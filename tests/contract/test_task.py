"""What every task promises of its prior, its simulator and its network.

Its labelled sets are in ``test_task_sets.py``, the variants that all tasks have in
``test_task_variants.py``. Bad
arguments of the simulators are tried in ``tests/integration/test_bad_inputs.py``.
"""

import copy
import math
import pickle
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from sbi.utils import within_support
from sbi.utils.user_input_checks import process_prior

from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS, inside_region
from tests.tasks import as_many, make, same_rows

# Priors that reach everywhere.
UNBOUNDED = {"linear_gaussian"}
# Variants with a prior of their own.
OTHER_PRIORS = [
    ("light_tunnel_sensors", "strong_colours"),
    ("light_tunnel_sensors", "strong_angles"),
]

TASK = pytest.mark.parametrize(
    "kind", [(name, None) for name in sorted(TASKS)], ids=str
)
PRIOR = pytest.mark.parametrize(
    "kind", [*((name, None) for name in sorted(TASKS)), *OTHER_PRIORS], ids=str
)


@pytest.fixture
def task(kind: tuple[str, str | None]) -> Task:
    return make(kind[0], variant=kind[1])


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


# The prior ---------------------------------------------------------------------------


@TASK
def test_the_description_has_an_entry_for_every_parameter_and_variant(
    task: Task,
) -> None:
    assert task.name in TASKS
    assert len(task.parameter_names) == len(task.parameter_units) == task.theta_dim
    assert len(set(task.parameter_names)) == task.theta_dim
    assert task.prior_std.shape == (task.theta_dim,)
    assert len(task.x_names) in (0, *task.x_shape)
    assert len(task.misspecification) > 20
    assert set(COMMON_VARIANTS) <= set(task.variants)
    assert all(len(sentence) > 20 for sentence in task.variants.values())
    assert set(task.shifted_region) <= set(task.parameter_names)


@PRIOR
def test_sbi_takes_the_prior_and_its_float32_draws_as_they_are(task: Task) -> None:
    prior = task.get_prior()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        processed, theta_dim, returns_numpy = process_prior(prior)
    assert processed is prior
    assert theta_dim == task.theta_dim
    assert not returns_numpy
    assert prior.event_shape == (task.theta_dim,)
    theta = prior.sample(torch.Size((1000,)))
    assert theta.shape == (1000, task.theta_dim)
    assert theta.dtype == torch.float32
    assert within_support(prior, theta).all()
    log_prob = prior.log_prob(theta)
    assert torch.isfinite(log_prob).all()
    for copied in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        torch.testing.assert_close(copied.log_prob(theta), log_prob)


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
    "wind_tunnel": ([[22.5]], [-math.log(45)]),
}


@pytest.mark.parametrize("name", ANALYTIC)
def test_the_density_of_the_prior_is_that_of_the_paper(name: str) -> None:
    theta, expected = ANALYTIC[name]
    log_prob = make(name).get_prior().log_prob(torch.tensor(theta))
    assert log_prob.tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.medium
@TASK
def test_the_parts_of_a_task_are_new_each_time_and_making_them_draws_nothing(
    task: Task,
) -> None:
    before = torch.get_rng_state()
    assert task.get_prior() is not task.get_prior()
    task.get_simulator()
    assert task.prior_std is not None
    assert torch.equal(before, torch.get_rng_state())
    with default_dtype(torch.float64):
        assert task.get_prior().sample().dtype == torch.float32
        theta = task.get_prior().sample(torch.Size((2,)))
        assert task.get_simulator()(theta).dtype == torch.float32


# The simulator and the network -------------------------------------------------------


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
    simulator, theta = task.get_simulator(), task.get_prior().sample((3,))
    draws = []
    for some, seed in (
        (simulator, 1),
        (simulator, 1),
        (pickle.loads(pickle.dumps(simulator)), 1),
        (simulator, 2),
    ):
        torch.manual_seed(seed)
        draws.append(some(theta))
    assert torch.equal(draws[0], draws[1])
    assert torch.equal(draws[0], draws[2])
    assert not torch.equal(draws[0], draws[3])
    first, second = simulator(theta[:1].expand(2, -1))
    assert not torch.equal(first, second)


@pytest.mark.medium
@TASK
def test_embedding_nets_are_new_and_use_all_of_their_parameters(task: Task) -> None:
    x = task.get_simulator()(task.get_prior().sample((50,)))
    sizes = []
    for light in (True, False):
        net, other = (task.get_embedding_net(light=light) for _ in range(2))
        statistics = net(x)
        assert statistics.ndim == 2
        assert len(statistics) == 50
        statistics.square().sum().backward()
        for name, parameter in net.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name
        pairs = list(zip(net.parameters(), other.parameters(), strict=True))
        assert all(p is not q for p, q in pairs)
        assert any(not torch.equal(p, q) for p, q in pairs)
        sizes.append(sum(p.numel() for p, _ in pairs))
    assert sizes[0] <= sizes[1]


@pytest.mark.medium
@TASK
def test_simulations_to_train_on_are_a_prefix_of_more_and_share_nothing_with_the_sets(
    task: Task,
) -> None:
    theta, x = task.get_simulations(150, seed=1)
    assert theta.shape == (150, task.theta_dim)
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
