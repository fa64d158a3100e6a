"""Arrays, lists and tables of numbers are taken wherever users pass data."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE, diagnose, load, stack
from sbi_rope.baselines import FRISBI
from sbi_rope.discrepancy import DiscrepancyNPE
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics import draw_samples, evaluate
from sbi_rope.trainers import FinetunedNPE
from sbi_rope.trainers.training import Training
from tests import gaussian, problems
from tests.stacks import (
    NPE,
    PRIOR,
    QUICK,
    QUIET,
    problem,
    quick,
    stacked,
)

PAIRS, OBSERVED = problem(12, seed=1), problem(25, seed=2)
QUICKLY: dict[str, Any] = {"num_simulations": 60, "seed": 0, **QUIET}


def array(tensor: Tensor) -> Any:
    """Return an array of float64, as NumPy makes them."""
    return tensor.double().numpy()


def rope(pairs: Any) -> RoPE:
    rope = RoPE(
        problems.npe_posterior("mdn"), simulator=problems.simulate, finetuner=QUICK
    )
    return rope.append_calibration(*pairs)


@pytest.mark.medium
@pytest.mark.parametrize("convert", [array, Tensor.tolist], ids=["arrays", "lists"])
def test_pairs_and_observations_are_those_of_tensors(convert: Any) -> None:
    theta_o, x_o = map(convert, OBSERVED)
    given = rope(map(convert, PAIRS))
    for ours, tensor in zip(given.calibration, PAIRS, strict=True):
        assert ours.dtype == torch.float32
        assert torch.equal(ours, tensor)
    given.train(seed=0, **QUIET)
    posterior = given.build_posterior(x_o, **QUICKLY)
    assert torch.equal(posterior.x_o, OBSERVED[1])
    # The posterior knows an observation again, in whatever form it comes.
    log_prob = posterior.log_prob_batched(theta_o, x=x_o)
    assert torch.allclose(log_prob.float(), posterior.log_prob_batched(*OBSERVED))
    assert posterior.sample((3,), x=x_o[1]).shape == (3, 2)
    assert posterior.sample_batched((3,), x=x_o, **QUIET).shape == (3, 25, 2)
    for scored in (posterior, problems.npe_posterior("mdn")):
        scores = evaluate(scored, theta_o, x_o, num_samples=20, seed=0, **QUIET)
        expected = evaluate(scored, *OBSERVED, num_samples=20, seed=0, **QUIET)
        assert scores.as_row() == pytest.approx(expected.as_row(), nan_ok=True)
        assert draw_samples(scored, x_o, num_samples=3).shape == (3, 25, 2)


@pytest.mark.medium
def test_a_stack_and_its_diagnosis_take_arrays() -> None:
    x_o = array(OBSERVED[1])
    posterior = stacked(
        rope(map(array, PAIRS)), x_o, candidates=[PRIOR, NPE], num_folds=2
    )
    assert posterior.sample_batched((2,), x=x_o, **QUIET).shape == (2, 25, 2)
    trained = rope(PAIRS).train(seed=0, **QUIET)
    options = {"num_simulations": 100, "num_folds": None, "seed": 0, **QUIET}
    assert str(diagnose(trained, x_o, **options)) == str(
        diagnose(trained, OBSERVED[1], **options)
    )


def test_stored_simulations_and_trainers_take_arrays() -> None:
    theta = problems.box(2).sample((1000,))
    x = problems.simulate(theta)
    npe = problems.npe_posterior("mdn")
    theta_s, x_s = RoPE(npe, simulations=(array(theta), array(x))).source.kept(
        2000, progress=False
    )
    assert torch.equal(theta_s.sort(dim=0).values, theta.sort(dim=0).values)
    assert torch.equal(x_s.sort(dim=0).values, x.sort(dim=0).values)
    method = FinetunedNPE.from_posterior(npe, training=Training(max_num_epochs=1))
    method.append_calibration(*map(array, PAIRS)).train(seed=0, **QUIET)
    assert method.build_posterior().sample((2,), x=PAIRS[1][0], **QUIET).shape == (2, 2)


def test_the_array_of_a_user_is_not_changed_or_shared() -> None:
    theta, x = (tensor.numpy().copy() for tensor in gaussian.labelled(20))
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=QUICK)
    rope.append_calibration(theta, x)
    x[:] = np.nan
    assert rope.calibration[1].isfinite().all()


def test_swapped_arguments_are_named_where_shapes_tell() -> None:
    theta, x = map(array, PAIRS)
    npe = problems.npe_posterior("mdn")
    method = FinetunedNPE.from_posterior(npe)
    method.append_calibration(theta, x)
    for call in (
        lambda: rope((x, theta)),
        lambda: RoPE(npe, simulations=(x, theta)),
        lambda: method.append_calibration(x, theta),
        lambda: evaluate(npe, x, theta),
    ):
        with pytest.raises(InvalidInputError, match="Did you swap them"):
            call()


# Tables ------------------------------------------------------------------------------

NAMES, CHANNELS = ["Vmax", "Km"], ["blue", "red"]
BANDS = [*CHANNELS, "infrared"]


def tables(count: int, seed: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return parameters with their real x, as tables with names of columns."""
    torch.manual_seed(seed)
    theta, x = gaussian.labelled(count)
    return pd.DataFrame(theta, columns=NAMES), pd.DataFrame(x, columns=CHANNELS)


THETA, X = tables(12, seed=1)
THETA_S, X_S = tables(1000, seed=2)
SWAPPED = THETA[NAMES[::-1]], X[CHANNELS[::-1]]


def refused(expected: list[str], source: str) -> Any:
    """Expect that columns are refused, because those of a source say another order."""
    text = f"order of {source}, {expected}; got {expected[::-1]}. Pass `df[{expected}]"
    return pytest.raises(InvalidInputError, match=re.escape(text))


def of_tables(**options: Any) -> RoPE:
    return RoPE(gaussian.posterior(), finetuner=QUICK, **options)


def test_tables_with_known_columns_are_those_of_tensors() -> None:
    rope = of_tables(simulations=(THETA_S, X_S)).append_calibration(THETA, X)
    for ours, table in zip(rope.calibration, (THETA, X), strict=True):
        assert torch.equal(ours, torch.tensor(table.to_numpy()))
    # Names that are other ones, or spelled differently, say nothing.
    for theta, x in (
        (SWAPPED[0].add_suffix(" [mM]"), SWAPPED[1].add_suffix(" (nm)")),
        (THETA.set_axis([1, 0], axis=1), X.set_axis([1, 0], axis=1)),
    ):
        rope.append_calibration(theta, x)
    rope.append_calibration(torch.tensor(THETA.to_numpy()), X.to_numpy())
    assert len(rope.labels) == 48


def tabled(theta: Tensor) -> pd.DataFrame:
    return pd.DataFrame(gaussian.simulator(theta), columns=CHANNELS)


def tabled_one(theta: Any) -> pd.Series:
    low, high = theta  # so that it takes no batch
    return tabled(torch.tensor([[float(low), float(high)]])).iloc[0]


@pytest.mark.parametrize(
    "options",
    [
        {"simulator": tabled},
        {"simulator": tabled_one},
        {"simulator": tabled, "num_simulations": 1000},
    ],
    ids=["batches", "one by one", "limited"],
)
def test_columns_of_a_simulator_are_known(options: dict[str, Any]) -> None:
    rope = of_tables(**options)
    with refused(CHANNELS, "the tables that `simulator` returns"):
        rope.append_calibration(THETA, SWAPPED[1])
    rope.append_calibration(THETA, X)
    method = DiscrepancyNPE.from_posterior(gaussian.posterior(), **options)
    method.append_calibration(THETA, SWAPPED[1])
    with pytest.raises(InvalidInputError, match=r"Expected `simulator\(.*Return `df"):
        method.train(**QUIET)


def test_columns_whose_names_are_not_strings_or_not_unique_keep_their_order() -> None:
    for names in ([0, 1], [("a", 1), ("a", 2)]):
        theta, x = THETA.set_axis(names, axis=1), X.set_axis(names, axis=1)
        known = of_tables(simulator=gaussian.simulator).append_calibration(theta, x)
        for swapped in ((theta[names[::-1]], x), (theta, x[names[::-1]])):
            with pytest.raises(InvalidInputError, match="columns in the order of the"):
                known.append_calibration(*swapped)
        known.append_calibration(theta, x)
    method = FRISBI(gaussian.posterior(3).prior, simulator=gaussian.simulator)
    doubled = pd.DataFrame(torch.zeros(4, 3), columns=["a", "a", "b"])
    method.append_simulations(doubled, doubled)
    with pytest.raises(InvalidInputError, match="columns in the order of the"):
        method.append_simulations(doubled.iloc[:, [0, 2, 1]], doubled)


def test_tables_whose_rows_are_in_different_orders_are_refused() -> None:
    rows = [f"plot {k}" for k in range(12)]
    theta, x = (table.set_axis(rows, axis=0) for table in (THETA, X))
    other, weights = x.iloc[::-1], theta["Km"].abs()[::-1]
    rope = of_tables(simulator=gaussian.simulator)
    method = FRISBI(gaussian.posterior().prior, simulator=gaussian.simulator)
    hint = re.escape(
        "row 'plot 0' of `theta` and row 'plot 11' of `x` in place 0. Pass"
    )
    for call in (
        lambda: rope.append_calibration(theta, other),
        lambda: method.append_calibration(theta, other),
        lambda: method.append_simulations(theta, other),
        lambda: evaluate(gaussian.posterior(), theta, other),
    ):
        with pytest.raises(InvalidInputError, match=hint):
            call()
    with pytest.raises(
        InvalidInputError, match=r"`theta` and `weights` with their row"
    ):
        rope.append_calibration(theta, x, weights=weights)
    with pytest.raises(InvalidInputError, match=r"`simulations\[1\]` with their rows"):
        of_tables(simulations=(THETA_S, X_S.iloc[::-1]))
    # Rows of which at least one table says nothing are paired by position.
    rope.append_calibration(theta, X).append_calibration(theta.to_numpy(), other)
    rope.append_calibration(theta, other.loc[rows], weights=weights.loc[rows])
    assert len(rope.labels) == 36


def test_the_parameters_of_a_table_of_simulations_have_its_names() -> None:
    assert of_tables(simulations=(THETA_S, X_S)).parameter_names == ("Vmax", "Km")
    names = ("a", "b")
    given = of_tables(simulations=(THETA_S, X_S), parameter_names=names)
    assert given.parameter_names == names
    for theta in (THETA_S.to_numpy(), THETA_S.set_axis(["a", "a"], axis=1)):
        assert of_tables(simulations=(theta, X_S)).parameter_names is None


def test_parameters_in_another_order_than_the_names_are_refused() -> None:
    named = of_tables(simulator=gaussian.simulator, parameter_names=NAMES)
    with refused(NAMES, "`parameter_names`"):
        named.append_calibration(SWAPPED[0], X)
    with refused(NAMES, "`parameter_names`"):
        of_tables(simulations=(THETA_S[NAMES[::-1]], X_S), parameter_names=NAMES)
    stored = of_tables(simulations=(THETA_S, X_S), parameter_names=["speed", "size"])
    with refused(NAMES, "the earlier table `simulations[0]`"):
        stored.append_calibration(SWAPPED[0], X)
    simulated = of_tables(simulator=gaussian.simulator).append_calibration(THETA, X)
    with refused(NAMES, "the earlier table `theta`"):
        simulated.append_calibration(SWAPPED[0], X)
    assert len(named.labels) == len(stored.labels) == 0
    assert len(simulated.labels) == 12


def test_the_noise_of_parameters_in_another_order_is_refused() -> None:
    named = of_tables(simulator=gaussian.simulator, parameter_names=NAMES)
    noise = SWAPPED[0].abs()
    for theta_std in (noise, noise.mean()):
        with refused(NAMES, "`parameter_names`"):
            named.append_calibration(THETA, X, theta_std=theta_std)
    unnamed = of_tables(simulator=gaussian.simulator)
    with refused(NAMES, "the earlier table `theta`"):
        unnamed.append_calibration(THETA, X, theta_std=noise)
    covariance = noise.cov()
    hint = re.escape(f"Pass `df.loc[{NAMES}, {NAMES}]`")
    with pytest.raises(InvalidInputError, match=hint):
        named.append_calibration(THETA, X, theta_cov=covariance)
    covariance = covariance.loc[NAMES, NAMES]
    rope = named.append_calibration(THETA, X, theta_cov=covariance)
    assert rope.labels.covariance[0].numpy() == pytest.approx(covariance.to_numpy())


def assert_columns_are_known(
    posterior: Any, right_theta: pd.DataFrame, right_x: pd.DataFrame
) -> None:
    """Fail unless a posterior and its sets refuse tables in another order."""
    theta, x = right_theta[NAMES[::-1]], right_x[BANDS[::-1]]
    first = right_x.iloc[0]
    of_x: list[Callable[[], Any]] = [
        lambda: posterior.sample((2,), x=x.iloc[0]),
        lambda: posterior.sample_batched((2,), x=x),
        lambda: posterior.set_default_x(x.iloc[0]),
        lambda: posterior.credible_intervals(0.5, x.iloc[0]),
        lambda: draw_samples(posterior, x, num_samples=2),
        lambda: evaluate(posterior, right_theta, x),
    ]
    of_theta: list[Callable[[], Any]] = [
        lambda: posterior.log_prob(theta, x=first),
        lambda: posterior.log_prob_batched(theta, x=right_x),
        lambda: posterior.potential(theta, x=first),
        lambda: posterior.credible_set(0.5, first).contains(theta),
        lambda: posterior.credible_intervals(0.5, first).contains(theta),
        lambda: evaluate(posterior, theta, right_x),
    ]
    for name, columns, calls in (("x", BANDS, of_x), ("theta", NAMES, of_theta)):
        for call in calls:
            with refused(columns, f"the earlier table `{name}`"):
                call()


@pytest.mark.filterwarnings("ignore:Coupling a batch:sbi_rope.errors.RoPEWarning")
def test_posteriors_refuse_tables_in_another_order_than_the_pairs(
    tmp_path: Path,
) -> None:
    theta, x = (
        pd.DataFrame(array(values), columns=names)
        for values, names in zip(PAIRS, (NAMES, BANDS), strict=True)
    )
    given = rope((theta, x)).train(**QUIET)
    with quick():
        whole = stack(given, candidates=[PRIOR, NPE], **QUIET)
    whole.save(tmp_path / "stack.pt")
    coupled = given.build_posterior(x, **QUICKLY)
    for posterior in (coupled, whole, load(tmp_path / "stack.pt")):
        assert_columns_are_known(posterior, theta, x)
    # Those in the right order are what tensors of the same numbers are.
    plain = torch.tensor(theta.to_numpy()), torch.tensor(x.to_numpy()[0])
    log_prob = whole.log_prob(theta, x=x.iloc[0])
    assert torch.equal(log_prob, whole.log_prob(plain[0], x=plain[1]))


def test_observations_in_another_order_than_earlier_ones_are_refused() -> None:
    stored = of_tables(simulations=(THETA_S, X_S))
    with refused(CHANNELS, "the earlier table `simulations[1]`"):
        stored.append_calibration(THETA, SWAPPED[1])
    simulated = of_tables(simulator=gaussian.simulator).append_calibration(THETA, X)
    with refused(CHANNELS, "the earlier table `x`"):
        simulated.append_calibration(THETA, SWAPPED[1])
    calls: list[Any] = [
        *(stored.embed, stored.build_posterior, stored.checked_observations),
        lambda x: diagnose(stored, x),
    ]
    for call in calls:
        with refused(CHANNELS, "the earlier table `simulations[1]`"):
            call(SWAPPED[1])
    with refused(CHANNELS, "the earlier table `x`"):
        stack(simulated, SWAPPED[1])  # type: ignore[arg-type]
    # A refused table leaves no names behind.
    other = of_tables(simulator=gaussian.simulator)
    with pytest.raises(InvalidInputError):
        other.append_calibration(THETA, SWAPPED[1][:3])
    other.append_calibration(THETA, X)


def test_trainers_refuse_tables_in_another_order_than_earlier_ones() -> None:
    method = FRISBI(gaussian.posterior().prior, simulator=gaussian.simulator)
    with pytest.raises(InvalidInputError):  # which leaves no names behind
        method.append_simulations(SWAPPED[0], SWAPPED[1][:3])
    method.append_simulations(THETA_S, X_S)
    for append in (method.append_simulations, method.append_calibration):
        with refused(CHANNELS, "the earlier table `x`"):
            append(THETA, SWAPPED[1])
        with refused(NAMES, "the earlier table `theta`"):
            append(SWAPPED[0], X)
        append(THETA, X)
    with refused(CHANNELS, "the earlier table `x`"):
        method.append_observations(SWAPPED[1])
    method.append_observations(X)


@pytest.mark.medium
def test_posteriors_of_trainers_know_the_columns_of_the_pairs() -> None:
    method = FinetunedNPE.from_posterior(
        gaussian.posterior(), training=Training(max_num_epochs=1)
    )
    method.append_calibration(THETA, X)
    posterior = method.train(seed=0, **QUIET).build_posterior()
    with refused(NAMES, "the earlier table `theta`"):
        evaluate(posterior, SWAPPED[0], X)
    with refused(CHANNELS, "the earlier table `x`"):
        draw_samples(posterior, SWAPPED[1], num_samples=2)
    assert draw_samples(posterior, X, num_samples=2).shape == (2, 12, 2)
    # What starts from them knows the columns, too.
    corrected = DiscrepancyNPE.from_posterior(
        gaussian.posterior(),
        simulator=gaussian.simulator,
        num_simulations=100,
        simulations_per_pair=3,
        num_steps=2,
        space="tuned",
    ).append_calibration(THETA, X)
    averaged = corrected.train(seed=0, **QUIET).build_posterior()
    for start in (posterior, averaged):
        again = FinetunedNPE.from_posterior(start)
        with refused(NAMES, "the earlier table `theta`"):
            again.append_calibration(SWAPPED[0], X)
    repaired = RoPE(posterior, simulator=gaussian.simulator, parameter_names=NAMES)
    with refused(CHANNELS, "the earlier table `x`"):
        repaired.append_calibration(THETA, SWAPPED[1])
    with pytest.raises(InvalidInputError, match="`parameter_names` in the order of"):
        RoPE(posterior, simulator=gaussian.simulator, parameter_names=NAMES[::-1])


def test_what_an_array_masks_is_missing() -> None:
    theta, x = map(array, PAIRS)
    x_masked = np.ma.masked_array(x, mask=np.zeros_like(x))
    x_masked[::3, 0] = np.ma.masked
    x_masked.data[::3, 0] = -9.0
    with pytest.raises(InvalidInputError, match="got NaN in 4 of 12 rows"):
        rope((theta, x_masked))
    with pytest.raises(InvalidInputError, match="NaN"):
        rope((theta, list(x_masked)))
    theta_masked = np.ma.masked_array(theta, mask=x_masked.mask[:, :2])
    known = rope((theta_masked, x)).labels.is_measured
    assert torch.equal(~known, torch.from_numpy(theta_masked.mask))
