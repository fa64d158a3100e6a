"""What every task promises, checked for all tasks and variants."""

import copy
import pickle
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.inference import DirectPosterior, simulate_for_sbi
from sbi.neural_nets import posterior_nn
from sbi.utils import within_support
from sbi.utils.user_input_checks import process_prior
from torch import Tensor

from sbi_rope.errors import InvalidInputError, InvalidTypeError, RoPEError
from sbi_rope.tasks import TASKS, Task, get_task
from sbi_rope.tasks.variants import COMMON_VARIANTS, inside_region
from tests.chamber_files import write_camera_experiments, write_impulses

# Fixtures that give the folder of a task's recorded data; other tasks are synthetic.
ROOT_FIXTURES = {"light_tunnel_sensors": "chamber_root"}
# Small images are quick to write, read and compare.
# Without 8-bit levels, no two of them are equal. Recorded sets have tests below.
OPTIONS: dict[str, dict[str, Any]] = {
    "light_tunnel": {"image_size": 64, "stand_in": True, "dequantise": True},
    "wind_tunnel": {"stand_in": True},
}
# Tasks with few stored observations, and how many these tests may take at once.
LARGEST = {"hemodynamics": 60}
# Tasks whose misspecification takes more than means and variances of x to see.
SUBTLE = {"hemodynamics"}
# Priors that reach everywhere.
UNBOUNDED = {"linear_gaussian"}
# Variants whose calibration set follows another law than the test set.
ANOTHER_CALIBRATION_LAW = {
    "biased_calibration",
    "noisy_labels",
    "sensor_settings",
    "flipped",
}
KINDS = [
    pytest.param(name, variant, id=name if variant is None else f"{name}-{variant}")
    for name, task in TASKS.items()
    for variant in (None, *task.variants)
]


def make(name: str, **options: Any) -> Task:
    return get_task(name, **OPTIONS.get(name, {}), **options)


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


@pytest.fixture
def root(request: pytest.FixtureRequest, name: str) -> Path | None:
    fixture = ROOT_FIXTURES.get(name)
    return None if fixture is None else request.getfixturevalue(fixture)


@pytest.fixture
def labelled(name: str, variant: str | None, root: Path | None) -> Task:
    return make(name, variant=variant, root=root)


def at_most(n: int, name: str) -> int:
    return min(n, LARGEST.get(name, n))


def rows_of(x: Tensor) -> list[bytes]:
    return [row.numpy().tobytes() for row in x.flatten(1)]


def same_rows(a: Tensor, b: Tensor) -> int:
    rows = set(rows_of(a))
    return sum(row in rows for row in rows_of(b))


def coarse(x: Tensor) -> Tensor:
    """Entries of x; of images, those of a coarser one."""
    if x.ndim == 4:
        x = torch.nn.functional.adaptive_avg_pool2d(x, 4)
    return x.flatten(1).double()


def largest_z(a: Tensor, b: Tensor) -> float:
    """Largest difference between means and variances of entries, in standard errors."""
    a, b = coarse(a), coarse(b)
    centre = (a.mean(dim=0) + b.mean(dim=0)) / 2
    a, b = (torch.cat([x, (x - centre) ** 2], dim=1) for x in (a, b))
    error = (a.var(dim=0) / len(a) + b.var(dim=0) / len(b)).sqrt()
    difference = (a.mean(dim=0) - b.mean(dim=0)).abs()
    return float((difference / error)[difference > 0].max())


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
    ],
)
def test_simulator_refuses_what_is_not_a_batch_of_parameters(
    task: Task, change: object, error: type[RoPEError], match: str
) -> None:
    theta = task.get_prior().sample((3,))
    with pytest.raises(error, match=match):
        task.get_simulator()(change(theta))  # type: ignore[operator]


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


# Labelled real observations ----------------------------------------------------------


@pytest.mark.parametrize(("name", "variant"), KINDS)
@pytest.mark.parametrize("part", ["calibration", "test"])
class TestOneSet:
    def test_has_the_shapes_asked_for(self, labelled: Task, part: str) -> None:
        n = at_most(130, labelled.name)
        theta, x = draw(labelled, part, n)
        assert theta.shape == (n, labelled.theta_dim)
        assert x.shape == (n, *labelled.x_shape)
        assert theta.dtype == x.dtype == torch.float32
        assert torch.isfinite(x).all()
        assert within_support(labelled.get_prior(), theta).all()

    def test_is_the_same_for_the_same_seed(self, labelled: Task, part: str) -> None:
        first, second = (
            draw(labelled, part, 20, seed=3),
            draw(labelled, part, 20, seed=3),
        )
        assert torch.equal(first[0], second[0])
        assert torch.equal(first[1], second[1])

    def test_differs_between_seeds(self, labelled: Task, part: str) -> None:
        first, second = (
            draw(labelled, part, 20, seed=3),
            draw(labelled, part, 20, seed=4),
        )
        assert not torch.equal(first[0], second[0])
        assert not torch.equal(first[1], second[1])

    def test_has_no_observation_twice(self, labelled: Task, part: str) -> None:
        n = at_most(250, labelled.name)
        _, x = draw(labelled, part, n)
        assert len(set(rows_of(x))) == n

    def test_begins_with_the_smaller_set(self, labelled: Task, part: str) -> None:
        n = at_most(130, labelled.name)
        small, large = draw(labelled, part, 7), draw(labelled, part, n)
        assert torch.equal(small[0], large[0][:7])
        assert torch.equal(small[1], large[1][:7])

    def test_leaves_the_global_random_states_alone(
        self, labelled: Task, part: str
    ) -> None:
        before = torch.get_rng_state(), random.getstate(), np.random.get_state()[1]  # noqa: NPY002
        draw(labelled, part, 5)
        after = torch.get_rng_state(), random.getstate(), np.random.get_state()[1]  # noqa: NPY002
        assert torch.equal(before[0], after[0])
        assert before[1] == after[1]
        assert np.array_equal(before[2], after[2])

    def test_is_the_same_whatever_torchs_default_dtype_and_device(
        self, labelled: Task, part: str
    ) -> None:
        expected = draw(labelled, part, 5)
        torch.set_default_dtype(torch.float64)
        try:
            with torch.device("meta"):
                theta, x = draw(labelled, part, 5)
        finally:
            torch.set_default_dtype(torch.float32)
        assert torch.equal(theta, expected[0])
        assert torch.equal(x, expected[1])

    def test_does_not_depend_on_the_global_seed(
        self, labelled: Task, part: str
    ) -> None:
        torch.manual_seed(1)
        first = draw(labelled, part, 5)
        torch.manual_seed(2)
        assert torch.equal(first[1], draw(labelled, part, 5)[1])

    @pytest.mark.parametrize("n", [0, -1, 2.0, True, "3"])
    def test_refuses_a_bad_size(self, labelled: Task, part: str, n: object) -> None:
        with pytest.raises(InvalidInputError, match="`n`"):
            draw(labelled, part, n)

    @pytest.mark.parametrize("seed", [-1, 2**31, 0.5, None, True])
    def test_refuses_a_bad_seed(self, labelled: Task, part: str, seed: object) -> None:
        with pytest.raises(InvalidInputError, match="`seed`"):
            draw(labelled, part, 5, seed=seed)


@pytest.mark.parametrize(("name", "variant"), KINDS)
@pytest.mark.parametrize("seeds", [(0, 0), (0, 1), (1, 0)])
def test_calibration_and_test_sets_share_no_observation(
    labelled: Task, seeds: tuple[int, int]
) -> None:
    n = at_most(250, labelled.name)
    calibration = labelled.get_calibration_set(n, seed=seeds[0])
    test = labelled.get_test_set(n, seed=seeds[1])
    assert same_rows(calibration[1], test[1]) == 0
    assert same_rows(calibration[0], test[0]) <= 0.01 * n


@pytest.mark.parametrize(("name", "variant"), KINDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_simulations_under_a_seed_share_no_parameter_with_its_sets(
    labelled: Task, seed: int
) -> None:
    torch.manual_seed(seed)
    theta = labelled.get_prior().sample((1000,))
    n = at_most(100, labelled.name)
    assert same_rows(theta, labelled.get_calibration_set(n, seed=seed)[0]) == 0
    assert same_rows(theta, labelled.get_test_set(n, seed=seed)[0]) == 0


@pytest.mark.parametrize(("name", "variant"), KINDS)
def test_nothing_is_printed(labelled: Task, capfd: pytest.CaptureFixture[str]) -> None:
    theta, _ = labelled.get_calibration_set(3)
    x, _ = labelled.get_simulator()(theta), labelled.get_test_set(3)
    labelled.get_embedding_net(light=True)(x)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("name", "variant"), KINDS)
def test_calibration_and_test_sets_follow_one_law(
    labelled: Task, variant: str | None
) -> None:
    calibration = labelled.get_calibration_set(at_most(250, labelled.name))
    test = labelled.get_test_set(at_most(1000, labelled.name))
    same_theta = largest_z(calibration[0], test[0]) < 4.5
    same_x = largest_z(calibration[1], test[1]) < 4.5
    if variant not in ANOTHER_CALIBRATION_LAW:
        assert same_theta
        assert same_x
    elif variant != "noisy_labels" and labelled.name not in LARGEST:
        assert not (same_theta and same_x)


@pytest.mark.parametrize(("name", "variant"), KINDS)
def test_real_law_is_the_simulated_law_only_where_the_task_says_so(
    labelled: Task, variant: str | None
) -> None:
    theta, x_o = labelled.get_test_set(at_most(1000, labelled.name))
    simulator = labelled.get_simulator()
    x_s = simulator(theta)
    assert largest_z(x_s, simulator(theta)) < 4.5
    if variant == "well_specified":
        assert labelled.has_data
        assert largest_z(x_s, x_o) < 4.5
    elif labelled.name not in SUBTLE:
        assert largest_z(x_s, x_o) > 6.0


@pytest.mark.parametrize("name", sorted(TASKS))
class TestCommonVariants:
    def test_shifted_parameters_stay_in_the_region(
        self, name: str, root: Path | None
    ) -> None:
        task = make(name, variant="prior_shift", root=root)
        n = at_most(100, name) // 3
        for theta, _ in (task.get_calibration_set(n), task.get_test_set(n)):
            for parameter, (low, high) in task.shifted_region.items():
                values = theta[:, task.parameter_names.index(parameter)]
                assert (values >= low).all()
                assert (values <= high).all()

    def test_biased_calibration_parameters_crowd_in_the_middle(
        self, name: str, root: Path | None
    ) -> None:
        task = make(name, variant="biased_calibration", root=root)
        n = at_most(200, name)
        calibration, test = (
            task.prior_quantiles(theta)[:, :3].std(dim=0)
            for theta, _ in (task.get_calibration_set(n), task.get_test_set(n))
        )
        # Standard deviations of Beta(3, 3) and of the uniform law, and a margin of
        # three standard errors or more.
        margin = 0.5 / n**0.5
        assert (calibration < 0.189 + margin).all()
        assert (test > 0.289 - margin).all()

    def test_noisy_labels_belong_to_the_observations_of_the_standard_task(
        self, name: str, root: Path | None
    ) -> None:
        clean, noisy = (
            make(name, variant=variant, root=root) for variant in (None, "noisy_labels")
        )
        n = at_most(200, name)
        theta, x = clean.get_calibration_set(n)
        noisy_theta, same_x = noisy.get_calibration_set(n)
        assert torch.equal(x, same_x)
        assert all(
            torch.equal(a, b)
            for a, b in zip(clean.get_test_set(50), noisy.get_test_set(50), strict=True)
        )
        scaled = (noisy_theta - theta) / clean.prior_std
        assert (scaled != 0).all()
        # Less than .2 where the prior's support cuts the noise.
        assert scaled.std(dim=0).max() < 0.2 * (1 + 2.2 / n**0.5)
        assert scaled.std(dim=0).min() > 0.2 * (0.85 - 2.2 / n**0.5)

    def test_label_noise_is_as_large_as_asked(
        self, name: str, root: Path | None
    ) -> None:
        small, large = (
            make(name, variant="noisy_labels", label_noise=noise, root=root)
            for noise in (0.001, 0.002)
        )
        n = at_most(200, name)
        truth, _ = make(name, root=root).get_calibration_set(n)
        ratio = [
            (task.get_calibration_set(n)[0] - truth).std(dim=0) / task.prior_std
            for task in (small, large)
        ]
        torch.testing.assert_close(
            ratio[0], torch.full_like(ratio[0], 0.001), rtol=2.8 / n**0.5, atol=0
        )
        torch.testing.assert_close(ratio[1], 2 * ratio[0], rtol=0.1, atol=0)

    @pytest.mark.parametrize("noise", [0.0, -0.1, 1.1, float("nan"), "0.1"])
    def test_bad_label_noise_is_refused(self, name: str, noise: object) -> None:
        with pytest.raises(InvalidInputError, match="label_noise"):
            make(name, variant="noisy_labels", label_noise=noise)

    def test_label_noise_without_its_variant_is_refused(self, name: str) -> None:
        with pytest.raises(InvalidInputError, match="noisy_labels"):
            make(name, label_noise=0.1)

    def test_well_specified_data_need_no_files(self, name: str) -> None:
        task = make(name, variant="well_specified")
        assert task.required_files == ()
        assert torch.isfinite(task.get_test_set(5)[1]).all()

    def test_unknown_variant_is_answered_with_those_there_are(self, name: str) -> None:
        with pytest.raises(InvalidInputError, match=r"prior_shift.*'nothing'"):
            make(name, variant="nothing")


# Tasks whose published files are too large for these tests, on files of their kind ----

RECORDED = {"light_tunnel": {"image_size": 64, "dequantise": True}, "wind_tunnel": {}}


@pytest.fixture(scope="session")
def written_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chambers")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        write_camera_experiments(root, num_rows=450)
        write_impulses(root, num_impulses=450)
    return root


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        pytest.param(name, variant, id=f"{name}-{variant}")
        for name in RECORDED
        for variant in (None, *TASKS[name].variants)
    ],
)
@pytest.mark.filterwarnings("ignore:.*the published file has")
class TestRecordedFiles:
    @pytest.fixture
    def recorded(self, name: str, variant: str | None, written_root: Path) -> Task:
        options = RECORDED[name]
        return get_task(name, variant=variant, root=written_root, **options)

    def test_sets_have_shapes_values_and_support(self, recorded: Task) -> None:
        assert recorded.has_data
        for part in ("calibration", "test"):
            theta, x = draw(recorded, part, 15)
            assert theta.shape == (15, recorded.theta_dim)
            assert x.shape == (15, *recorded.x_shape)
            assert theta.dtype == x.dtype == torch.float32
            assert torch.isfinite(x).all()
            assert within_support(recorded.get_prior(), theta).all()
            assert torch.isfinite(recorded.get_prior().log_prob(theta)).all()

    def test_sets_are_reproducible_prefixes_that_differ_between_seeds(
        self, recorded: Task
    ) -> None:
        for part in ("calibration", "test"):
            few, many = (
                draw(recorded, part, 5, seed=1),
                draw(recorded, part, 15, seed=1),
            )
            assert torch.equal(few[0], many[0][:5])
            assert torch.equal(few[1], many[1][:5])
            assert not torch.equal(many[0], draw(recorded, part, 15, seed=2)[0])

    def test_calibration_and_test_sets_share_no_observation(
        self, recorded: Task
    ) -> None:
        calibration = [recorded.get_calibration_set(15, seed=s)[1] for s in (0, 1)]
        test = [recorded.get_test_set(30, seed=s)[1] for s in (0, 1)]
        assert same_rows(torch.cat(calibration), torch.cat(test)) == 0

    def test_sets_leave_the_global_random_state_alone(self, recorded: Task) -> None:
        before = torch.get_rng_state()
        draw(recorded, "calibration", 5)
        assert torch.equal(before, torch.get_rng_state())

    def test_real_law_is_the_simulated_law_only_where_the_task_says_so(
        self, recorded: Task, variant: str | None
    ) -> None:
        theta, x_o = recorded.get_test_set(60)
        different = largest_z(recorded.get_simulator()(theta), x_o) > 4.5
        assert different == (variant != "well_specified")


def draw(
    task: Task, part: str, n: object, *, seed: object = 0
) -> tuple[Tensor, Tensor]:
    get = task.get_calibration_set if part == "calibration" else task.get_test_set
    return get(n, seed=seed)  # type: ignore[arg-type]
