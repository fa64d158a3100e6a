"""The baselines."""

import functools
from typing import Any

from torch import Tensor

from sbi_rope import baselines
from sbi_rope.discrepancy import DiscrepancyNPE
from tests import gaussian
from tests.faults.outcomes import Call
from tests.faults.problem import (
    FROM_LISTS,
    PAIRS,
    PRIOR,
    QUIET,
    SIMULATIONS,
    THETA,
    X_O,
    X,
    npe,
)


def appended(method: Any, what: str, *data: Tensor) -> Any:
    getattr(method, f"append_{what}")(*data)
    return getattr(method._data, what)


# The noise of these inputs has draws and a density that are numbers.
OF_NOISE = {"log_prob": ("Inf",), "sample_like": ("NaN", "Inf")}
# Bad inputs that mean something where the values of x are never read.
ANY_X = tuple(
    f"x: {what}"
    for what in (
        "one dimension more",
        "one column more",
        "NaN",
        "Inf",
        "without values",
    )
)
# The data that can be appended to baselines.
DATA = {
    "calibration": PAIRS,
    "simulations": SIMULATIONS,
    "observations": {"x_o": X_O},
}
METHODS: dict[str, Any] = {
    "PlainNPE": baselines.PlainNPE,
    "ReferenceNPE": baselines.ReferenceNPE,
    "NNPE": baselines.NNPE,
    "RNPE": baselines.RNPE,
    "RVNP": baselines.RVNP,
    "NPERS": baselines.NPERS,
    "JointNPE": baselines.JointNPE,
    "FinetunedNPE": baselines.FinetunedNPE,
    "CalibrationMLP": baselines.CalibrationMLP,
    "FMCPE": functools.partial(baselines.FMCPE, simulator=gaussian.simulator),
    "FRISBI": functools.partial(baselines.FRISBI, simulator=gaussian.simulator),
    "OTOnly": functools.partial(baselines.OTOnly, simulator=gaussian.simulator),
    "TuningOnly": functools.partial(baselines.TuningOnly, simulator=gaussian.simulator),
    "HVAE": functools.partial(baselines.HVAE, physics=lambda theta: theta),
    "DiscrepancyNPE": DiscrepancyNPE,
}
CALLS = [
    Call(
        name=f"{name}.append_{what}",
        run=lambda make=make, what=what, **tensors: appended(
            make(PRIOR), what, *(DATA[what] | tensors).values()
        ),
        tensors=tensors,
        accepts=(
            # The first x that is appended sets the shape of an observation.
            "x: one column more",
            "x_o: one column more",
            "x: one dimension more",
            "x_o: one dimension more",
            "x_o: one row less",
            # Such simulations are dropped.
            *(("x: NaN", "x: Inf") if what == "simulations" else ()),
        ),
    )
    for name, make in METHODS.items()
    for what, tensors in DATA.items()
    if what in (make if isinstance(make, type) else make.func).sees
]
CALLS += [
    Call(
        name=name,
        run=lambda make=make, prior=None, **options: repr(
            type(make(PRIOR if prior is None else prior, **options))
        ),
        options={"prior": "instance", "device": "device"},
    )
    for name, make in {**METHODS, "PriorBaseline": baselines.PriorBaseline}.items()
]
CALLS += [
    Call(
        name="CalibrationMLP.train",
        run=lambda theta=THETA, x=X, x_o=X_O, seed=0: (
            baselines.CalibrationMLP(
                PRIOR, training=baselines.Training(max_num_epochs=2)
            )
            .append_calibration(theta, x)
            .train(seed=seed, **QUIET)
            .build_posterior()
            .sample_batched((3,), x=x_o, **QUIET)
        ),
        tensors={},
        options={"seed": "seed"},
        is_random=True,
    ),
    Call(
        name="ReferenceNPE.simulated_test_set",
        run=lambda theta, seed=0: baselines.ReferenceNPE.from_posterior(
            npe()
        ).simulated_test_set(theta, gaussian.simulator, seed=seed),
        tensors={"theta": THETA},
        options={"seed": "seed"},
        accepts=("theta: one row less",),
    ),
    Call(
        name="Training",
        run=lambda **options: repr(baselines.Training(**options)),
        options={
            "training_batch_size": "count",
            "learning_rate": "rate",
            "validation_fraction": "positive",
            "stop_after_epochs": "count",
            "max_num_epochs": "count",
            "clip_max_norm": "positive",
        },
    ),
    Call(
        name="PriorPosterior.log_prob",
        run=lambda theta: baselines.PriorPosterior(PRIOR).log_prob(theta),
        tensors={"theta": THETA},
        accepts=("theta: one row less", "theta: Inf", *FROM_LISTS),
    ),
    Call(
        name="PriorPosterior.log_prob_batched",
        run=lambda theta=THETA, x=X: baselines.PriorPosterior(PRIOR).log_prob_batched(
            theta, x
        ),
        tensors=PAIRS,
        # The values of x are never read.
        accepts=("theta: Inf", *FROM_LISTS, *ANY_X),
    ),
    Call(
        name="PriorPosterior.sample_batched",
        run=lambda x: baselines.PriorPosterior(PRIOR).sample_batched((3,), x),
        tensors={"x": X},
        accepts=("x: one row less", "x: one dimension less", *ANY_X),
        is_random=True,
    ),
    Call(
        name="SpikeAndSlab",
        run=lambda **options: repr(baselines.SpikeAndSlab(**options)),
        options={
            "spike_std": "positive",
            "slab_scale": "positive",
            "slab_probability": "share",
            "bound": "positive",
        },
    ),
    *(
        Call(
            name=f"SpikeAndSlab.{method}",
            run=getattr(baselines.SpikeAndSlab(), method),
            tensors={name: THETA},
            accepts=tuple(
                f"{name}: {what}"
                for what in (
                    "one dimension more",
                    "one dimension less",
                    "one column more",
                    "one row less",
                    "no dimension",
                    "no rows",
                    # The result has the dtype of the argument.
                    "float64",
                    "half",
                    "bfloat16",
                    *OF_NOISE[method],
                )
            ),
            is_random=True,
        )
        for method, name in (("log_prob", "noise"), ("sample_like", "x"))
    ),
    Call(
        name="PriorPosterior",
        run=lambda prior=PRIOR: repr(baselines.PriorPosterior(prior)),
        options={"prior": "instance"},
    ),
    Call(
        name="PriorPosterior.sample",
        run=lambda sample_shape=(3,): baselines.PriorPosterior(PRIOR).sample(
            sample_shape
        ),
        options={"sample_shape": "shape"},
        is_random=True,
    ),
    Call(
        name="PriorPosterior.to",
        run=lambda device="cpu": baselines.PriorPosterior(PRIOR).to(device),
        options={"device": "device"},
    ),
]
