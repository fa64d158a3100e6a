"""Every baseline keeps one contract: data goes in, a posterior of sbi comes out."""

import copy
import inspect
import pickle
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import within_support
from torch import Size, Tensor, nn

import sbi_rope.baselines
from sbi_rope import load, save
from sbi_rope.baselines import CalibrationMLP, Method, PlainNPE, Regression
from sbi_rope.density import MixturePosterior
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.methods.base import Kind
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    RoPEError,
    RoPEWarning,
)
from sbi_rope.utils.seeds import seeded
from tests import baselines, problems
from tests.baselines import (
    METHODS,
    SHORT,
    append,
    data_of,
    densities,
    expected_densities,
    feed,
    first_task,
    log_prob,
    log_prob_batched,
    make,
    result,
    sample,
    sample_batched,
    task_of,
    train,
    trained,
)

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*mixed neural density estimator"),
    pytest.mark.filterwarnings("ignore:Inferring num_categories"),
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:.*lie outside the prior support"),
    pytest.mark.filterwarnings("ignore:RNPE. the chains of"),
    pytest.mark.filterwarnings("ignore:Capping max_sampling_batch_size"),
]

KINDS: tuple[Kind, ...] = ("simulations", "calibration", "observations")
# What `Method` does for all is tried on two that are fast and see all kinds of data.
FAST = ("joint_npe", "npe_rs")
APPENDED = [
    ("joint_npe", "simulations"),
    ("joint_npe", "calibration"),
    ("npe_rs", "observations"),
]
# One for each kind of posterior: of the others the estimator is one of sbi's, too.
ONE_OF_A_KIND = (
    "prior",
    "npe",
    "ot_only",
    "calibration_mlp",
    "finetuned_npe_averaged",
    "nnpe",
    "rnpe",
)
every_method = pytest.mark.parametrize("name", METHODS)


# Which data a method sees.

SEES = {
    "CalibrationMLP": {"calibration"},
    "DiscrepancyNPE": {"simulations", "calibration"},
    "FMCPE": {"simulations", "calibration"},
    "FRISBI": {"simulations", "calibration", "observations"},
    "FinetunedNPE": {"simulations", "calibration"},
    "HVAE": {"simulations", "calibration", "observations"},
    "JointNPE": {"simulations", "calibration"},
    "NNPE": {"simulations"},
    "NPERS": {"simulations", "observations"},
    "OTOnly": {"simulations", "observations"},
    "PlainNPE": {"simulations"},
    "PriorBaseline": set(),
    "RNPE": {"simulations"},
    "RVNP": {"simulations", "observations"},
    "ReferenceNPE": {"simulations"},
    "Regression": {"calibration"},
    "TuningOnly": {"simulations", "calibration"},
}


def test_every_method_is_held_to_this_contract_and_sees_what_it_says() -> None:
    public = [getattr(sbi_rope.baselines, name) for name in sbi_rope.baselines.__all__]
    kinds = {kind for kind in public if inspect.isclass(kind)} | {DiscrepancyNPE}
    methods = {k for k in kinds if issubclass(k, Method) and k is not Method}
    assert methods == {entry.kind for entry in METHODS.values()}
    assert {kind.__name__: set(kind.sees) for kind in methods} == SEES
    # All take data and train as their common base does, and none takes labels of
    # observations.
    shared = {f"append_{kind}" for kind in KINDS} | {"train", "build_posterior"}
    assert not any(shared & vars(kind).keys() for kind in methods)
    assert list(inspect.signature(Method.append_observations).parameters)[1:] == ["x_o"]


def test_data_that_are_missing_or_not_seen_are_named() -> None:
    for name, entry in METHODS.items():
        data = data_of(first_task(name))
        for kind in KINDS:
            method = make(name, first_task(name))
            if kind not in entry.kind.sees:
                with pytest.raises(InvalidInputError, match="a method that sees"):
                    append(method, kind, data)
                continue
            feed(method, data, without=kind)
            with pytest.raises(NotReadyError, match=rf"append_{kind}\("):
                method.train(seed=0, show_progress_bars=False)


# What comes out.


@pytest.mark.medium
@every_method
def test_samples_and_densities_have_the_shapes_of_sbi(name: str) -> None:
    posterior, data = result(name), data_of(first_task(name))
    dim = data.theta.shape[1]
    assert sample(posterior, (4,), data.x_o[0]).shape == (4, dim)
    assert sample(posterior, (), data.x_o[:1]).shape[-1] == dim
    samples = sample_batched(posterior, (4,), data.x_o[:3])
    assert samples.shape == (4, 3, dim)
    assert samples.dtype is torch.float32
    assert samples.isfinite().all()

    theta = data.theta[:6].reshape(2, 3, -1)
    assert log_prob(posterior, data.theta[:5], data.x_o[0]).shape == (5,)
    assert log_prob_batched(posterior, theta[0], data.x_o[:3]).shape == (1, 3)
    values = log_prob_batched(posterior, theta, data.x_o[:3])
    assert values.shape == (2, 3)
    assert values.dtype is torch.float32
    assert not values.requires_grad
    tolerance = 1e-4
    if isinstance(posterior, MixturePosterior):  # which is divided by an estimate
        mass = posterior.leakage_correction(data.x_o[:3])
        tolerance += 6 * float(problems.error_of_mass(mass).max())
    assert tolerance < 0.3
    for i in range(3):
        single = log_prob(posterior, theta[:, i], data.x_o[i])
        assert torch.allclose(single, values[:, i], atol=tolerance)


NUM_POINTS, STEP = 121, 0.15


@pytest.mark.medium
@pytest.mark.parametrize("name", ONE_OF_A_KIND)
def test_the_density_integrates_to_one_and_is_that_of_the_samples(name: str) -> None:
    """By the rectangle rule, to 1 %; marginals by Kolmogorov and Smirnov, at 0.1 %."""
    posterior, x = result(name, "linear_gaussian"), data_of("linear_gaussian").x_o[1]
    axis = torch.linspace(-9, 9, NUM_POINTS)
    grid = torch.cartesian_prod(axis, axis)
    with torch.no_grad():
        mass = STEP**2 * log_prob(posterior, grid, x).double().exp()
    assert float(mass.sum()) == pytest.approx(1, abs=0.01)
    samples = sample(posterior, (2000,), x).double()
    for k in range(2):
        marginal = mass.reshape(NUM_POINTS, NUM_POINTS).sum(dim=1 - k)
        below = (samples[:, k, None] <= axis + STEP / 2).double().mean(dim=0)
        assert float((below - marginal.cumsum(0)).abs().max()) < 1.95 / 2000**0.5


@pytest.mark.medium
@pytest.mark.parametrize("name", [*ONE_OF_A_KIND, "fmcpe", "frisbi"])
def test_inside_a_bounded_prior_is_the_mass_that_the_samples_have_there(
    name: str,
) -> None:
    """By importance sampling from the prior, to five standard errors."""
    task = "light_tunnel_sensors"
    if not task_of(task).has_data:
        pytest.skip(f"the data of {task} are not on this machine")
    posterior, x = result(name, task), data_of(task).x_o[0]
    prior = task_of(task).get_prior()
    theta = prior.sample(Size((20_000,)))
    with torch.no_grad():
        log_weights = log_prob(posterior, theta, x) - prior.log_prob(theta)
    weights = log_weights.double().exp()
    inside = within_support(prior, sample(posterior, (4000,), x)).double()
    error = (weights.var() / 20_000 + inside.var() / 4000).sqrt()
    if isinstance(posterior, MixturePosterior):  # which is divided by an estimate
        of_mass = problems.error_of_mass(posterior.leakage_correction(x[None]))
        error = (error.square() + of_mass.square()).sqrt()
    assert float(error) < 0.1
    assert abs(float(weights.mean() - inside.mean())) < 5 * float(error) + 1e-6
    outside = theta.clone()
    outside[:, 0] += 1e4
    assert torch.isneginf(log_prob(posterior, outside[:5], x)).all()


@pytest.mark.medium
@pytest.mark.parametrize("name", [*ONE_OF_A_KIND, "fmcpe", "frisbi", "hvae"])
def test_a_posterior_that_is_copied_saved_or_moved_has_the_same_density(
    name: str, tmp_path: Path
) -> None:
    posterior, expected = result(name), expected_densities(name)
    assert posterior is not result(name)  # each that is built is one's own
    save(posterior, tmp_path / "posterior.pt")
    for other in (
        copy.deepcopy(posterior),
        pickle.loads(pickle.dumps(posterior)),
        load(tmp_path / "posterior.pt"),
    ):
        assert type(other) is type(posterior)
        assert torch.equal(densities(other, name), expected)
    task = METHODS[name].tasks[-1]
    if task == "linear_gaussian" or not task_of(task).has_data:
        return  # sbi moves no posterior whose prior is torch's own
    posterior, expected = result(name, task), expected_densities(name, task)
    posterior.to("cpu")
    assert torch.equal(densities(posterior, name, task), expected)
    assert sample(posterior, (3,), data_of(task).x_o[0]).isfinite().all()


# Training.


def states() -> tuple[bytes, str, Any]:
    numpy_state = np.random.get_state()  # noqa: NPY002
    return torch.get_rng_state().numpy().tobytes(), str(numpy_state), random.getstate()


@pytest.mark.medium
@every_method
def test_the_seed_alone_decides_and_training_leaves_no_trace(
    name: str, terminal: pytest.CaptureFixture[str]
) -> None:
    task = first_task(name)
    data = data_of(task).map(torch.clone)
    net = baselines.flat_net(data.x[0].numel())
    net.load_state_dict(baselines.net_of(task).state_dict())
    prior = task_of(task).get_prior()
    weights, law = copy.deepcopy(net.state_dict()), pickle.dumps(prior)
    density_estimator = baselines.builder(task, net=net)
    method = make(name, task, prior=prior, density_estimator=density_estimator)
    feed(method, data)
    expected, before = expected_densities(name), states()
    terminal.readouterr()
    with_another = densities(train(method, seed=1).build_posterior(), name)
    # A training starts anew, whatever was trained before.
    assert train(method, seed=0) is method
    with_the_same = densities(method.build_posterior(), name)
    assert states() == before
    assert torch.equal(with_the_same, expected)
    if name not in ("prior", "regression"):
        assert not torch.allclose(with_another, expected, atol=1e-3)
    # Nothing is said if no progress is asked for, and what was passed in is unchanged.
    printed = terminal.readouterr()
    assert printed.out == printed.err == ""
    assert all(torch.equal(weights[k], v) for k, v in net.state_dict().items())
    assert net.training
    assert all(p.requires_grad and p.grad is None for p in net.parameters())
    assert pickle.dumps(prior) == law
    for field, value in vars(data).items():
        assert torch.equal(value, getattr(data_of(task), field))


@pytest.mark.medium
@pytest.mark.parametrize(
    "name", [name for name, entry in METHODS.items() if entry.kind.starts_from_npe]
)
def test_a_posterior_trained_beforehand_does_as_well_and_is_not_changed(
    name: str,
) -> None:
    task = first_task(name)
    data = data_of(task)
    npe = PlainNPE(
        task_of(task).get_prior(), baselines.builder(task), npe_training=SHORT
    )
    npe.append_simulations(data.theta, data.x)
    options = dict(METHODS[name].options(task_of(task)))
    options.pop("npe_training")
    with seeded(0):
        given = train(npe, seed=None).build_posterior()
        state = torch.get_rng_state()
        weights = copy.deepcopy(given.posterior_estimator.state_dict())
        method = feed(METHODS[name].kind.from_posterior(given, **options), data)
        torch.set_rng_state(state)
        posterior = train(method, seed=None).build_posterior()
    assert torch.equal(densities(posterior, name), expected_densities(name))
    after = given.posterior_estimator
    assert all(torch.equal(weights[k], v) for k, v in after.state_dict().items())
    assert all(p.grad is None for p in after.parameters())
    with pytest.raises(InvalidInputError, match=r"`x` of shape"):
        method.append_simulations(data.theta, torch.cat([data.x, data.x], dim=-1))


# What is appended.


@pytest.mark.parametrize(("name", "kind"), APPENDED)
def test_data_appended_after_the_training_ask_for_another(
    name: str, kind: Kind
) -> None:
    method = copy.deepcopy(trained(name, first_task(name)))
    append(method, kind, data_of(first_task(name)))
    for ask in (method.build_posterior, lambda: method.history):
        with pytest.raises(NotReadyError):
            ask()


@pytest.mark.parametrize("name", FAST)
def test_what_is_appended_is_copied_and_may_come_in_parts(name: str) -> None:
    data, method = data_of(first_task(name)), make(name, first_task(name))
    for part in (slice(12), slice(12, None)):
        own = data.map(lambda value, part=part: value[part].clone())
        feed(method, own)
        own.map(lambda value: value.fill_(0.25))
    posterior = train(method).build_posterior()
    assert torch.equal(densities(posterior, name), expected_densities(name))


@pytest.mark.parametrize(("name", "kind"), APPENDED)
def test_what_is_refused_is_not_appended(name: str, kind: Kind) -> None:
    data = data_of(first_task(name))
    method = feed(make(name, first_task(name)), data)
    bad = data.map(lambda v: v.clone().index_fill_(0, torch.tensor(1), torch.nan))
    with pytest.raises(InvalidInputError):
        append(method, kind, bad)
    posterior = train(method).build_posterior()
    assert torch.equal(densities(posterior, name), expected_densities(name))


@pytest.mark.parametrize("kind", ["simulations", "calibration"])
def test_parameters_outside_the_prior_are_refused(kind: Kind) -> None:
    outside = data_of("pendulum").map(lambda value: value + 1e4)
    prior = task_of("pendulum").get_prior()
    method = baselines.JointNPE(prior, baselines.builder("pendulum"))
    with pytest.raises(InvalidInputError, match="`theta` inside the support"):
        append(method, kind, outside)


@pytest.mark.parametrize("name", FAST)
def test_simulations_with_nan_are_dropped_with_a_warning(name: str) -> None:
    data, method = data_of(first_task(name)), make(name, first_task(name))
    x = torch.cat([data.x[:7], data.x[:2] * torch.nan, data.x[7:]])
    theta = torch.cat([data.theta[:7], data.theta[:2], data.theta[7:]])
    feed(method, data, without="simulations")
    with pytest.warns(RoPEWarning, match="Dropped 2 of 102 simulations"):
        method.append_simulations(theta, x)
    posterior = train(method).build_posterior()
    assert torch.equal(densities(posterior, name), expected_densities(name))


# Few pairs, and no embedding net.


@pytest.mark.medium
@pytest.mark.parametrize(
    "name",
    [
        "tuning_only",
        "calibration_mlp",
        "discrepancy_embedding",
        "npe_rs",
        "nnpe",
        "rnpe",
    ],
)
def test_the_density_estimator_can_do_without_an_embedding_net(name: str) -> None:
    task = first_task(name)
    density_estimator = baselines.builder(task, net=nn.Identity())
    method = feed(make(name, task, density_estimator=density_estimator), data_of(task))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RoPEWarning)
        posterior = train(method).build_posterior()
        assert densities(posterior, name).isfinite().all()


def with_pairs(name: str, theta: Tensor, x: Tensor) -> Method:
    method = make(name, first_task(name))
    feed(method, data_of(first_task(name)), without="calibration")
    return method.append_calibration(theta, x)


@pytest.mark.medium
@pytest.mark.parametrize("name", baselines.names_that_see("calibration"))
def test_few_pairs_are_enough_with_a_warning(name: str) -> None:
    data = data_of(first_task(name))
    one = with_pairs(name, data.theta_cal[:1], data.x_cal[:1])
    # One has nothing else to standardise by, and one learns an error from two.
    if isinstance(one, CalibrationMLP | DiscrepancyNPE | Regression):
        with pytest.raises(RoPEError, match="at least 2 rows"):
            train(one)
    else:
        with pytest.warns(RoPEWarning, match="1 calibration pair"):
            train(one)
        assert densities(one.build_posterior(), name).isfinite().all()
    if isinstance(one, DiscrepancyNPE | Regression):
        return
    # Recordings of four people leave none to hold out.
    four = with_pairs(name, data.theta_cal[:4].repeat(5, 1), data.x_cal)
    with pytest.warns(RoPEWarning, match="Only 4 different parameters"):
        train(four)
    assert densities(four.build_posterior(), name).isfinite().all()
