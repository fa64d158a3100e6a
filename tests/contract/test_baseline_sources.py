"""Which data the methods see, and where their NPE comes from."""

import copy
import inspect
from typing import Any

import pytest
import torch

import sbi_rope.baselines
from sbi_rope._random import seeded
from sbi_rope.baselines import Method, PlainNPE
from sbi_rope.discrepancy import DiscrepancyNPE
from sbi_rope.errors import InvalidInputError
from tests import baselines
from tests.baselines import (
    METHODS,
    SHORT,
    append,
    data_of,
    densities,
    expected_densities,
    feed,
    first_task,
    make,
    result,
    task_of,
    train,
)

KINDS = ("simulations", "calibration", "observations")

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


def public_methods() -> list[type[Method]]:
    public = [getattr(sbi_rope.baselines, name) for name in sbi_rope.baselines.__all__]
    kinds = {kind for kind in public if inspect.isclass(kind)} | {DiscrepancyNPE}
    return [kind for kind in kinds if issubclass(kind, Method) and kind is not Method]


def test_every_method_is_held_to_this_contract() -> None:
    assert set(public_methods()) == {entry.kind for entry in METHODS.values()}
    assert {kind.__name__: set(kind.sees) for kind in public_methods()} == SEES


def test_every_method_takes_data_and_trains_as_their_common_base_does() -> None:
    shared = {f"append_{kind}" for kind in KINDS} | {"train", "build_posterior"}
    for kind in public_methods():
        assert not shared & vars(kind).keys(), kind


def test_no_method_takes_labels_of_observations() -> None:
    calls = {name for name, _ in inspect.getmembers(Method) if "append_" in name}
    assert calls == {f"append_{kind}" for kind in KINDS}
    assert list(inspect.signature(Method.append_observations).parameters)[1:] == ["x_o"]
    options = list(inspect.signature(Method.train).parameters)
    assert options == ["self", "seed", "show_progress_bars"]


def test_data_that_a_method_does_not_see_are_refused() -> None:
    for name, entry in METHODS.items():
        method, data = make(name, first_task(name)), data_of(first_task(name))
        for kind in set(KINDS) - entry.kind.sees:
            with pytest.raises(InvalidInputError, match="Expected a method that sees"):
                append(method, kind, data)


# NPE trained beforehand.

BUILDERS = [name for name, entry in METHODS.items() if entry.kind.starts_from_npe]


def given(name: str, posterior: Any) -> Any:
    """A method that starts from a trained posterior."""
    task = first_task(name)
    options = dict(METHODS[name].options(task_of(task)))
    options.pop("npe_training")
    return METHODS[name].kind.from_posterior(posterior, **options)


@pytest.mark.medium
@pytest.mark.parametrize("name", BUILDERS)
def test_a_posterior_trained_beforehand_does_as_well_and_is_not_changed(
    name: str,
) -> None:
    task = first_task(name)
    data = data_of(task)
    npe = PlainNPE(
        task_of(task).get_prior(), baselines.builder(task), npe_training=SHORT
    )
    npe.append_simulations(data.theta, data.x)
    with seeded(0):
        trained_npe = train(npe, seed=None).build_posterior()
        state = torch.get_rng_state()
        weights = copy.deepcopy(trained_npe.posterior_estimator.state_dict())
        method = feed(given(name, trained_npe), data)
        torch.set_rng_state(state)
        posterior = train(method, seed=None).build_posterior()
    assert torch.equal(densities(posterior, name), expected_densities(name))
    after = trained_npe.posterior_estimator
    assert all(torch.equal(weights[k], v) for k, v in after.state_dict().items())
    assert all(p.grad is None for p in after.parameters())


@pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")
def test_a_posterior_trained_beforehand_fixes_the_shape_of_x() -> None:
    for name in BUILDERS:
        data = data_of(first_task(name))
        method = given(name, result("npe", first_task(name)))
        longer = torch.cat([data.x, data.x], dim=-1)
        with pytest.raises(InvalidInputError, match=r"`x` of shape"):
            method.append_simulations(data.theta, longer)
