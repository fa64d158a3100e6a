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
from torch import nn

import sbi_rope.baselines
from sbi_rope import load, save
from sbi_rope.baselines import CalibrationMLP, PlainNPE, Regression
from sbi_rope.methods import DiscrepancyNPE, Method
from sbi_rope.methods.base import Kind
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    RoPEError,
    RoPEWarning,
)
from sbi_rope.utils.seeds import seeded
from tests import baselines
from tests.baselines import (
    BOUNDED,
    METHODS,
    append,
    data_of,
    densities,
    expected_densities,
    feed,
    log_prob,
    make,
    result,
    sample,
    task_of,
    train,
    trained,
)

pytestmark = pytest.mark.filterwarnings("ignore")

KINDS: tuple[Kind, ...] = ("simulations", "calibration", "observations")
# What `Method` does for all is tried on two that are fast and see all kinds of data.
FAST = ("joint_npe", "npe_rs")
APPENDED = [
    ("joint_npe", "simulations"),
    ("joint_npe", "calibration"),
    ("npe_rs", "observations"),
]
# One for each kind of posterior: of the others the estimator is one of sbi's, too.
AVERAGED = "finetuned_npe_averaged"
ONE_OF_A_KIND = ("prior", "npe", "ot_only", "calibration_mlp", AVERAGED, "nnpe", "rnpe")
every_method = pytest.mark.parametrize("name", METHODS)


def own(name: str) -> Any:
    """The data of the task that a method is tried on."""
    return data_of(METHODS[name].task)


# Which data a method sees.


def test_every_method_is_held_to_this_contract_and_none_can_see_labels_of_a_test() -> (
    None
):
    rooms = sbi_rope.baselines, sbi_rope.methods
    public = [getattr(room, name) for room in rooms for name in room.__all__]
    kinds = {kind for kind in public if inspect.isclass(kind)}
    methods = {k for k in kinds if issubclass(k, Method) and k is not Method}
    assert methods == {entry.kind for entry in METHODS.values()}
    # All take data and train as their common base does.
    shared = {f"append_{kind}" for kind in KINDS} | {"train", "build_posterior"}
    assert not any(shared & vars(kind).keys() for kind in methods)
    assert list(inspect.signature(Method.append_observations).parameters)[1:] == ["x_o"]


def test_data_that_are_missing_or_not_seen_are_named() -> None:
    for name, entry in METHODS.items():
        for kind in KINDS:
            method = make(name)
            if kind not in entry.kind.sees:
                with pytest.raises(InvalidInputError, match="a method that sees"):
                    append(method, kind, own(name))
                continue
            feed(method, own(name), without=kind)
            with pytest.raises(NotReadyError, match=rf"append_{kind}\("):
                method.train(seed=0, show_progress_bars=False)


# What comes out.


@pytest.mark.medium
@every_method
def test_samples_and_densities_have_the_shapes_of_sbi(name: str) -> None:
    posterior, data = result(name), own(name)
    dim = data.theta.shape[1]
    options = {"reject_outside_prior": False, "show_progress_bars": False}
    assert posterior.sample((4,), x=data.x_o[0], **options).shape == (4, dim)
    assert posterior.sample((), x=data.x_o[:1], **options).shape[-1] == dim
    samples = sample(posterior, 4, data.x_o[:3])
    assert samples.shape == (4, 3, dim)
    assert samples.dtype is torch.float32
    assert samples.isfinite().all()
    theta = data.theta[:6].reshape(2, 3, -1)
    assert log_prob(posterior, theta[0], data.x_o[:3]).shape == (1, 3)
    values = log_prob(posterior, theta, data.x_o[:3])
    assert values.shape == (2, 3)
    assert values.dtype is torch.float32
    assert not values.requires_grad
    for i in range(3):
        single = posterior.log_prob(theta[:, i], x=data.x_o[i], norm_posterior=False)
        assert torch.allclose(single, values[:, i], atol=1e-4)


NUM_POINTS, STEP = 121, 0.15


@pytest.mark.medium
@pytest.mark.parametrize("name", ONE_OF_A_KIND)
def test_the_density_integrates_to_one_and_is_that_of_the_samples(name: str) -> None:
    """By the rectangle rule, to 1 %; marginals by Kolmogorov and Smirnov, at 0.1 %."""
    posterior, x = result(name, "linear_gaussian"), data_of("linear_gaussian").x_o[1:2]
    axis = torch.linspace(-9, 9, NUM_POINTS)
    grid = torch.cartesian_prod(axis, axis)
    with torch.no_grad():
        mass = STEP**2 * log_prob(posterior, grid[:, None], x).double().exp()
    assert float(mass.sum()) == pytest.approx(1, abs=0.01)
    samples = sample(posterior, 2000, x)[:, 0].double()
    for k in range(2):
        marginal = mass.reshape(NUM_POINTS, NUM_POINTS).sum(dim=1 - k)
        below = (samples[:, k, None] <= axis + STEP / 2).double().mean(dim=0)
        assert float((below - marginal.cumsum(0)).abs().max()) < 1.95 / 2000**0.5


@pytest.mark.medium
@pytest.mark.parametrize("name", [*ONE_OF_A_KIND, "frisbi"])
def test_inside_a_bounded_prior_is_the_mass_that_the_samples_have_there(
    name: str,
) -> None:
    """By importance sampling from the prior, to five standard errors."""
    posterior, x = result(name, BOUNDED), data_of(BOUNDED).x_o[:1]
    prior = task_of(BOUNDED).get_prior()
    theta = prior.sample(torch.Size((5000,)))
    with torch.no_grad():
        log_density = log_prob(posterior, theta[:, None], x)[:, 0]
    weights = (log_density - prior.log_prob(theta)).double().exp()
    inside = within_support(prior, sample(posterior, 4000, x)[:, 0]).double()
    error = float((weights.var() / 5000 + inside.var() / 4000).sqrt())
    assert error < 0.1
    assert abs(float(weights.mean() - inside.mean())) < 5 * error + 1e-6
    assert torch.isneginf(log_prob(posterior, theta[:5, None] + 1e4, x)).all()


@pytest.mark.medium
@pytest.mark.parametrize("name", [*ONE_OF_A_KIND, "fmcpe", "frisbi", "hvae"])
def test_a_posterior_that_is_copied_saved_or_moved_has_the_same_density(
    name: str, tmp_path: Path
) -> None:
    posterior = result(name, BOUNDED)
    assert posterior is not result(name, BOUNDED)  # each that is built is one's own
    save(posterior, tmp_path / "posterior.pt")
    moved = copy.deepcopy(posterior)
    moved.to("cpu")
    pickled, loaded = pickle.dumps(posterior), load(tmp_path / "posterior.pt")
    for other in (moved, pickle.loads(pickled), loaded):
        assert type(other) is type(posterior)
        found = densities(other, BOUNDED)
        assert torch.equal(found, expected_densities(name, BOUNDED))
        assert sample(other, 3, data_of(BOUNDED).x_o[:1]).isfinite().all()


# Training.


def states() -> tuple[bytes, str, Any]:
    numpy_state = np.random.get_state()  # noqa: NPY002
    return torch.get_rng_state().numpy().tobytes(), str(numpy_state), random.getstate()


@pytest.mark.medium
@every_method
def test_the_seed_alone_decides_and_training_leaves_no_trace(
    name: str, terminal: pytest.CaptureFixture[str]
) -> None:
    task = METHODS[name].task
    data, net = data_of(task).map(torch.clone), baselines.net_of(task)
    weights = copy.deepcopy(net.state_dict())
    method = feed(make(name, net=net), data)
    expected, before = expected_densities(name), states()
    terminal.readouterr()
    with_another = densities(train(method, seed=1).build_posterior(), task)
    # A training starts anew, whatever was trained before.
    assert train(method, seed=0) is method
    with_the_same = densities(method.build_posterior(), task)
    assert states() == before
    assert torch.equal(with_the_same, expected)
    if name not in ("prior", "regression"):
        assert not torch.allclose(with_another, expected, atol=1e-3)
    # Nothing is said if no progress is asked for, and what was passed in is unchanged.
    assert terminal.readouterr() == ("", "")
    assert all(torch.equal(weights[k], v) for k, v in net.state_dict().items())
    assert net.training
    assert all(p.requires_grad and p.grad is None for p in net.parameters())
    for field, value in vars(data).items():
        assert torch.equal(value, getattr(data_of(task), field))


@pytest.mark.medium
@pytest.mark.parametrize(
    "name", [name for name, entry in METHODS.items() if entry.kind.starts_from_npe]
)
def test_a_posterior_trained_beforehand_does_as_well_and_is_not_changed(
    name: str,
) -> None:
    entry, data = METHODS[name], own(name)
    options = {key: value for key, value in entry.options.items() if key[:3] != "npe"}
    npe = PlainNPE(
        task_of(entry.task).get_prior(), baselines.builder(entry.task), **baselines.NPE
    )
    npe.append_simulations(data.theta, data.x)
    with seeded(0):
        given = train(npe, seed=None).build_posterior()
        state = torch.get_rng_state()
        estimator = given.posterior_estimator
        weights = copy.deepcopy(estimator.state_dict())
        method = feed(entry.kind.from_posterior(given, **options), data)
        torch.set_rng_state(state)
        posterior = train(method, seed=None).build_posterior()
    assert torch.equal(densities(posterior, entry.task), expected_densities(name))
    assert all(torch.equal(weights[k], v) for k, v in estimator.state_dict().items())
    assert all(p.grad is None for p in estimator.parameters())
    with pytest.raises(InvalidInputError, match=r"`x` of shape"):
        method.append_simulations(data.theta, torch.cat([data.x, data.x], dim=-1))


# What is appended.


@pytest.mark.parametrize(("name", "kind"), APPENDED)
def test_data_appended_after_the_training_ask_for_another(
    name: str, kind: Kind
) -> None:
    method = append(copy.deepcopy(trained(name)), kind, own(name))
    for ask in (method.build_posterior, lambda: method.history):
        with pytest.raises(NotReadyError):
            ask()


@pytest.mark.parametrize(("name", "kind"), APPENDED)
def test_data_are_copied_and_come_in_parts_and_what_is_refused_is_left_out(
    name: str, kind: Kind
) -> None:
    method = make(name)
    bad = own(name).map(lambda v: v.clone().index_fill_(0, torch.tensor(1), torch.nan))
    for part in (slice(12), slice(12, None)):
        data = own(name).map(lambda value, part=part: value[part].clone())
        feed(method, data)
        data.map(lambda value: value.fill_(0.25))
        with pytest.raises(InvalidInputError):
            append(method, kind, bad)
    posterior = train(method).build_posterior()
    assert torch.equal(
        densities(posterior, METHODS[name].task), expected_densities(name)
    )


@pytest.mark.parametrize("kind", ["simulations", "calibration"])
def test_parameters_outside_the_prior_are_refused(kind: Kind) -> None:
    outside = data_of(BOUNDED).map(lambda value: value + 1e4)
    with pytest.raises(InvalidInputError, match="`theta` inside the support"):
        append(make("joint_npe", BOUNDED), kind, outside)


@pytest.mark.parametrize("name", FAST)
def test_simulations_with_nan_are_dropped_with_a_warning(name: str) -> None:
    data, method = own(name), make(name)
    feed(method, data, without="simulations")
    x = torch.cat([data.x[:7], data.x[:2] * torch.nan, data.x[7:]])
    theta = torch.cat([data.theta[:7], data.theta[:2], data.theta[7:]])
    with pytest.warns(RoPEWarning, match="Dropped 2 of 102 simulations"):
        method.append_simulations(theta, x)
    posterior = train(method).build_posterior()
    assert torch.equal(
        densities(posterior, METHODS[name].task), expected_densities(name)
    )


# Few pairs, and no embedding net.

NO_NET = ("tuning_only", "calibration_mlp", "discrepancy_embedding", "npe_rs", "rnpe")


@pytest.mark.medium
@pytest.mark.parametrize("name", NO_NET)
def test_the_density_estimator_can_do_without_an_embedding_net(name: str) -> None:
    method = feed(make(name, net=nn.Identity()), own(name))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RoPEWarning)
        posterior = train(method).build_posterior()
        assert densities(posterior, METHODS[name].task).isfinite().all()


@pytest.mark.medium
@pytest.mark.parametrize("name", baselines.names_that_see("calibration"))
def test_few_pairs_are_enough_with_a_warning(name: str) -> None:
    data, task = own(name), METHODS[name].task
    one, four = (feed(make(name), data, without="calibration") for _ in range(2))
    one.append_calibration(data.theta_cal[:1], data.x_cal[:1])
    # One has nothing else to standardise by, and one learns an error from two.
    if isinstance(one, CalibrationMLP | DiscrepancyNPE | Regression):
        with pytest.raises(RoPEError, match="at least 2 rows"):
            train(one)
    else:
        with pytest.warns(RoPEWarning, match="1 calibration pair"):
            train(one)
        assert densities(one.build_posterior(), task).isfinite().all()
    if isinstance(one, DiscrepancyNPE | Regression):
        return
    # Recordings of four people leave none to hold out.
    four.append_calibration(data.theta_cal[:4].repeat(5, 1), data.x_cal)
    with pytest.warns(RoPEWarning, match="Only 4 different parameters"):
        train(four)
    assert densities(four.build_posterior(), task).isfinite().all()
