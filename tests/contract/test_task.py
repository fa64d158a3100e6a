"""What every task promises of its prior, its simulator and its network.

Its labelled sets are in ``test_task_sets.py``, the variants that all tasks have in
``test_task_variants.py``, files of published data in ``test_task_recorded.py``.
"""

import copy
import pickle
import warnings
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior, simulate_for_sbi
from sbi.neural_nets import posterior_nn
from sbi.utils import within_support
from sbi.utils.user_input_checks import process_prior

from sbi_rope.errors import InvalidInputError, InvalidTypeError, RoPEError
from sbi_rope.tasks import TASKS, Task
from sbi_rope.tasks.variants import COMMON_VARIANTS, inside_region
from tests.tasks import at_most, make, same_rows

# Priors that reach everywhere.
UNBOUNDED = {"linear_gaussian"}
# Variants with a prior of their own.
OTHER_PRIORS = [
    ("light_tunnel_sensors", "strong_colours"),
    ("light_tunnel_sensors", "strong_angles"),
]


@pytest.fixture(
    params=[*((name, None) for name in sorted(TASKS)), *OTHER_PRIORS],
    ids=lambda kind: "-".join(filter(None, kind)),
)
def task(request: pytest.FixtureRequest) -> Task:
    name, variant = request.param
    return make(name, variant=variant)


# The prior ---------------------------------------------------------------------------


def test_description_has_one_entry_per_parameter(task: Task) -> None:
    assert task.name in TASKS
    assert len(task.parameter_names) == len(task.parameter_units) == task.theta_dim
    assert len(set(task.parameter_names)) == task.theta_dim
    assert task.prior_std.shape == (task.theta_dim,)
    assert len(task.x_names) in (0, *task.x_shape)


def test_description_says_what_is_wrong_and_what_the_variants_are(task: Task) -> None:
    assert len(task.misspecification) > 20
    assert set(COMMON_VARIANTS) <= set(task.variants)
    assert all(len(sentence) > 20 for sentence in task.variants.values())
    assert set(task.shifted_region) <= set(task.parameter_names)


def test_prior_passes_the_checks_of_sbi_unchanged(task: Task) -> None:
    prior = task.get_prior()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        processed, theta_dim, returns_numpy = process_prior(prior)
    assert processed is prior
    assert theta_dim == task.theta_dim
    assert not returns_numpy
    assert prior.event_shape == (task.theta_dim,)


def test_prior_draws_are_float32_inside_its_support(task: Task) -> None:
    prior = task.get_prior()
    theta = prior.sample(torch.Size((1000,)))
    assert theta.shape == (1000, task.theta_dim)
    assert theta.dtype == torch.float32
    assert within_support(prior, theta).all()
    assert torch.isfinite(prior.log_prob(theta)).all()


def test_prior_is_float32_whatever_the_default_dtype(task: Task) -> None:
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert task.get_prior().sample().dtype == torch.float32
        assert (
            task.get_simulator()(task.get_prior().sample((2,))).dtype == torch.float32
        )
    finally:
        torch.set_default_dtype(default)


def test_prior_density_integrates_to_one(task: Task) -> None:
    prior = process_prior(task.get_prior())[0]
    draws = prior.sample((50_000,))
    low, high = draws.min(dim=0).values, draws.max(dim=0).values
    margin = 0.05 * (high - low)
    low, high = low - margin, high + margin
    box = low + (high - low) * torch.rand(200_000, task.theta_dim)
    mass = prior.log_prob(box).double().exp().mean() * (high - low).double().prod()
    assert mass == pytest.approx(1.0, abs=0.015)


def test_prior_density_is_zero_outside_its_support(task: Task) -> None:
    if task.name in UNBOUNDED:
        pytest.skip("the support has no outside")
    prior = process_prior(task.get_prior())[0]
    draws = prior.sample((1000,))
    width = draws.max(dim=0).values - draws.min(dim=0).values
    for outside in (draws - 1.1 * width, draws + 1.1 * width):
        assert not within_support(prior, outside).any()
        assert (prior.log_prob(outside) == -torch.inf).all()


def test_prior_std_is_that_of_draws_from_the_prior(task: Task) -> None:
    draws = task.get_prior().sample((50_000,))
    torch.testing.assert_close(draws.std(dim=0), task.prior_std, rtol=0.02, atol=0.0)


def test_prior_quantiles_of_draws_are_uniform(task: Task) -> None:
    quantiles = task.prior_quantiles(task.get_prior().sample(torch.Size((20_000,))))
    assert quantiles.shape == (20_000, task.theta_dim)
    steps = torch.arange(1, 20_001) / 20_000
    distance = (quantiles.sort(dim=0).values - steps[:, None]).abs().max()
    # Kolmogorov's distance is above 2.5 / sqrt(n) once in a hundred thousand.
    assert distance < 2.5 / 20_000**0.5


def test_shifted_region_is_a_proper_part_of_the_prior(task: Task) -> None:
    theta = task.get_prior().sample(torch.Size((2000,)))
    inside = inside_region(theta, task.parameter_names, task.shifted_region)
    assert 0.05 < inside.mean() < 0.75


def test_prior_can_be_copied_and_pickled(task: Task) -> None:
    prior = task.get_prior()
    theta = prior.sample((5,))
    for copied in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        torch.testing.assert_close(copied.log_prob(theta), prior.log_prob(theta))


def test_making_the_parts_of_a_task_draws_nothing(task: Task) -> None:
    before = torch.get_rng_state()
    task.get_prior()
    task.get_simulator()
    assert task.prior_std is not None
    assert torch.equal(before, torch.get_rng_state())


def test_each_call_returns_a_new_prior(task: Task) -> None:
    assert task.get_prior() is not task.get_prior()


# The simulator and the network -------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_simulator_returns_finite_batches(task: Task, n: int) -> None:
    x = task.get_simulator()(task.get_prior().sample((1000,))[:n])
    assert x.shape == (n, *task.x_shape)
    assert x.dtype == torch.float32
    assert torch.isfinite(x).all()


def test_simulator_follows_the_global_seed(task: Task) -> None:
    simulator, theta = task.get_simulator(), task.get_prior().sample((3,))
    draws = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        draws.append(simulator(theta))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_simulator_gives_equal_parameters_different_noise(task: Task) -> None:
    theta = task.get_prior().sample((1,)).expand(2, -1)
    first, second = task.get_simulator()(theta)
    assert not torch.equal(first, second)


def test_simulator_keeps_the_dtype_of_theta(task: Task) -> None:
    theta = task.get_prior().sample((2,))
    assert task.get_simulator()(theta.double()).dtype == torch.float64


def test_simulator_can_be_pickled(task: Task) -> None:
    theta = task.get_prior().sample((3,))
    simulator = task.get_simulator()
    copied = pickle.loads(pickle.dumps(simulator))
    torch.manual_seed(0)
    expected = simulator(theta)
    torch.manual_seed(0)
    assert torch.equal(copied(theta), expected)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        pytest.param(lambda t: t.tolist(), InvalidTypeError, "Tensor", id="list"),
        pytest.param(lambda t: t[0], InvalidInputError, "shape", id="no-batch"),
        pytest.param(lambda t: t[:, 1:], InvalidInputError, "shape", id="width"),
        pytest.param(lambda t: t * torch.nan, InvalidInputError, "finite", id="nan"),
        pytest.param(lambda t: t.long(), InvalidTypeError, "floating", id="integer"),
        pytest.param(lambda t: t.to_sparse(), InvalidTypeError, "dense", id="sparse"),
        pytest.param(
            lambda t: 1e30 * t.abs(), InvalidInputError, "theta", id="overflow"
        ),
    ],
)
def test_simulator_and_quantiles_refuse_what_is_not_a_batch_of_parameters(
    task: Task, change: object, error: type[RoPEError], match: str
) -> None:
    theta = task.get_prior().sample((3,))
    with pytest.raises(error, match=match):
        task.get_simulator()(change(theta))  # type: ignore[operator]
    with pytest.raises(error, match=match):
        task.prior_quantiles(change(theta))  # type: ignore[operator]


@pytest.mark.parametrize("light", ["x", 1, None])
def test_a_light_network_is_asked_for_by_a_bool(task: Task, light: Any) -> None:
    with pytest.raises(InvalidTypeError, match="`light`"):
        task.get_embedding_net(light=light)


def test_sbi_can_simulate_from_the_task(task: Task) -> None:
    prior = process_prior(task.get_prior())[0]
    theta, x = simulate_for_sbi(
        task.get_simulator(), prior, 20, show_progress_bar=False
    )
    assert theta.shape == (20, task.theta_dim)
    assert x.shape == (20, *task.x_shape)


@pytest.mark.parametrize("light", [False, True])
def test_embedding_net_returns_one_row_of_statistics_per_observation(
    task: Task, light: bool
) -> None:
    x = task.get_simulator()(task.get_prior().sample((6,)))
    statistics = task.get_embedding_net(light=light)(x)
    assert statistics.ndim == 2
    assert statistics.shape[0] == 6


@pytest.mark.parametrize("light", [False, True])
def test_gradients_reach_every_parameter_of_the_embedding_net(
    task: Task, light: bool
) -> None:
    net = task.get_embedding_net(light=light)
    x = task.get_simulator()(task.get_prior().sample((50,)))
    net(x).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("light", [False, True])
def test_each_call_returns_a_new_embedding_net(task: Task, light: bool) -> None:
    first, second = (task.get_embedding_net(light=light) for _ in range(2))
    assert not {id(p) for p in first.parameters()} & {
        id(p) for p in second.parameters()
    }
    different = (
        not torch.equal(p, q)
        for p, q in zip(first.parameters(), second.parameters(), strict=True)
    )
    assert any(different)


def test_light_embedding_net_has_no_more_parameters(task: Task) -> None:
    sizes = [
        sum(p.numel() for p in task.get_embedding_net(light=light).parameters())
        for light in (True, False)
    ]
    assert sizes[0] <= sizes[1]


def test_simulations_to_train_on_are_a_prefix_of_more_and_of_no_set(
    task: Task,
) -> None:
    theta, x = task.get_simulations(150, seed=1)
    assert theta.shape == (150, task.theta_dim)
    assert x.shape == (150, *task.x_shape)
    assert within_support(task.get_prior(), theta).all()
    few = task.get_simulations(7, seed=1)
    assert torch.equal(few[0], theta[:7])
    assert torch.equal(few[1], x[:7])
    if task.has_data:
        n = at_most(100, task.name)
        assert same_rows(theta, task.get_calibration_set(n, seed=1)[0]) == 0
        assert same_rows(theta, task.get_test_set(n, seed=1)[0]) == 0
    assert same_rows(x, task.get_simulations(150, seed=2)[1]) == 0


def test_sbi_builds_a_posterior_on_the_task(task: Task) -> None:
    prior = process_prior(task.get_prior())[0]
    theta = prior.sample((200,))
    x = task.get_simulator()(theta)
    build = posterior_nn(
        "mdn", embedding_net=task.get_embedding_net(), z_score_x=task.z_score_x
    )
    posterior = DirectPosterior(build(theta, x), prior).set_default_x(x[:1])
    assert torch.isfinite(
        posterior.log_prob(
            theta, leakage_correction_params={"num_rejection_samples": 100}
        )
    ).any()
    assert within_support(
        prior, posterior.sample((20,), show_progress_bars=False)
    ).all()
    mode = posterior.map(
        num_iter=2, num_init_samples=20, num_to_optimize=2, show_progress_bars=False
    )
    assert within_support(prior, mode).all()
    restored = pickle.loads(pickle.dumps(posterior))
    assert within_support(restored.prior, theta).all()
