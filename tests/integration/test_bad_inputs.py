"""Bad inputs at the public entry points are refused, and the argument is named.

A bad input that means something to a call is listed with the value that is right.
"""

import functools
import inspect
import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_rope import (
    CalibrationFinetuner,
    RoPE,
    SinkhornCoupler,
    diagnose,
    metrics,
    stack,
)
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.stacking import default_candidates
from sbi_rope.utils.errors import RoPEError
from tests import gaussian

pytestmark = pytest.mark.filterwarnings("ignore")

Call = Callable[..., Any]
PRIOR = BoxUniform(-4 * torch.ones(2), 4 * torch.ones(2))


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


THETA, THETA_S, X_O = draw(0, 20, 2), draw(1, 60, 2), 1.4 * draw(4, 20, 2) + 0.7
X, X_S = 1.4 * (THETA + 0.5 * draw(2, 20, 2)) + 0.7, THETA_S + 0.5 * draw(3, 60, 2)

ONES = torch.ones(20, 2)


@functools.cache
def npe() -> Any:
    return DirectPosterior(gaussian.GaussianEstimator(), PRIOR)


def untrained(**options: Any) -> RoPE:
    finetuner = CalibrationFinetuner(max_num_epochs=2)
    return RoPE(npe(), simulator=gaussian.simulator, finetuner=finetuner, **options)


@functools.cache
def trained() -> RoPE:
    return untrained().append_calibration(THETA, X).train(seed=0)


@functools.cache
def stacked() -> Any:
    candidates = [c for c in default_candidates() if c.name in ("prior", "NPE")]
    return stack(trained(), candidates=candidates, num_folds=2, seed=0)


def with_simulations(theta: Tensor = THETA_S, x: Tensor = X_S) -> Tensor:
    rope = RoPE(npe(), simulations=(theta, x))
    return rope.embed(X_O, seed=0)[3]


DRAWN: Any = {"num_samples": 20, "seed": 0}
# The public calls, each with good tensors as defaults.
CALLS: dict[str, Call] = {
    "RoPE": with_simulations,
    "RoPE.append_calibration": lambda theta=THETA, x=X: (
        untrained().append_calibration(theta, x).pairs.mean
    ),
    "RoPE.append_calibration(noise)": lambda theta_std=ONES: (
        untrained().append_calibration(THETA, X, theta_std=theta_std)
    ),
    "RoPE.append_calibration(weights)": lambda weights=ONES[:, 0]: (
        untrained().append_calibration(THETA, X, weights=weights)
    ),
    "RoPE.build_posterior": lambda x_o=X_O: trained().build_posterior(x_o),
    "SinkhornCoupler.couple": lambda real=X_O, simulated=X_S: SinkhornCoupler().couple(
        real, simulated
    ),
    "stack": lambda x_o=X_O: stack(trained(), x_o),
    "diagnose": lambda x_o=X_O: diagnose(trained(), x_o, num_folds=None),
    "sample": lambda x=X_O[:1]: stacked().sample((5,), x=x),
    "log_prob": lambda theta=THETA, x=X_O[:1]: stacked().log_prob(theta, x=x),
    "log_prob_batched": lambda theta=THETA, x=X_O: stacked().log_prob_batched(theta, x),
    "credible_set": lambda x=X_O: stacked().credible_set(0.9, x, **DRAWN),
    "contains": lambda theta=THETA: (
        stacked().credible_set(0.9, X_O[0], **DRAWN).contains(theta)
    ),
    "evaluate": lambda theta=THETA, x=X: metrics.evaluate(stacked(), theta, x),
    "method.append_calibration": lambda theta=THETA, x=X: (
        DiscrepancyNPE(PRIOR)
        .append_simulations(THETA_S, X_S)
        .append_calibration(theta, x)
    ),
}


def spoilt(good: Tensor, value: float) -> Tensor:
    """A copy with another value in the middle."""
    bad = good.clone()
    bad.view(-1)[bad.numel() // 2] = value
    return bad


BAD: dict[str, Callable[[Tensor], Any]] = {
    "ndim": lambda good: good[..., None],
    "width": lambda good: torch.cat([good, good[..., :1]], dim=-1),
    "empty": lambda good: good[:0],
    "NaN": lambda good: spoilt(good, math.nan),
    "Inf": lambda good: spoilt(good, math.inf),
    "text": lambda good: "x",
}


# What some bad inputs mean to some calls, as a condition on the result: a missing label
# is imputed, a simulation is dropped, or a parameter is impossible.
MEANS: dict[str, Callable[[Any], bool]] = {
    "RoPE.append_calibration(theta: NaN)": lambda found: bool(found.isfinite().all()),
    **{
        f"RoPE({name}: {bad})": lambda found: found.shape == (59, 2)
        for name, bad in itertools.product(("theta", "x"), ("NaN", "Inf"))
    },
    **{
        f"{name}(theta: Inf)": lambda found: int(found.isneginf().sum()) == 1
        for name in ("log_prob", "log_prob_batched")
    },
}


def good_tensors(call: Call) -> dict[str, Tensor]:
    return {n: p.default for n, p in inspect.signature(call).parameters.items()}


def verdict(name: str, argument: str, label: str, bad: Any) -> str:
    """What a call does wrong with a bad argument; nothing if it refuses it by name."""
    good = good_tensors(CALLS[name])
    means = MEANS.get(f"{name}({argument}: {label})")
    try:
        found = CALLS[name](**{**good, argument: bad})
    except RoPEError as error:
        names = (*good, "simulations") if name == "RoPE" else good
        is_named = any(f"`{one}" in str(error) for one in names)
        return "" if is_named and len(str(error)) < 400 else str(error)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if means and means(found) else "accepted"


@pytest.mark.medium
@pytest.mark.parametrize(
    ("name", "argument"),
    [(name, argument) for name in CALLS for argument in good_tensors(CALLS[name])],
)
def test_a_bad_tensor_is_refused_or_means_something(name: str, argument: str) -> None:
    good = good_tensors(CALLS[name])[argument]
    for label, spoil in BAD.items():
        wrong = verdict(name, argument, label, spoil(good))
        assert not wrong, label


SETTINGS: dict[str, Callable[..., Any]] = {
    "gamma": SinkhornCoupler,
    "num_folds": lambda **bad: stack(trained(), **bad),
    "seed": lambda **bad: trained().build_posterior(X_O, **bad),
    "level": lambda **bad: stacked().credible_set(x=X_O[0], **bad),
    "num_samples": lambda **bad: metrics.evaluate(stacked(), THETA, X, **bad),
}


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("value", [-1, math.nan, "x"])
def test_a_bad_setting_is_refused(name: str, value: Any) -> None:
    with pytest.raises(RoPEError, match=f"`{name}`.*; got {value!r}"):
        SETTINGS[name](**{name: value})
