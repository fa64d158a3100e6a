"""The model of the discrepancy."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope.discrepancy import DiscrepancyModel, DiscrepancyNPE, learn_parameters
from tests.faults.outcomes import Call
from tests.faults.problem import (
    NOISE,
    PAIRS,
    PRIOR,
    QUIET,
    THETA,
    THETA_S,
    X_S,
    X,
    fitted_discrepancy,
    npe,
)


def fitted(**tensors: Tensor) -> Any:
    given = {"z": X, "mean": THETA, "covariance": NOISE} | tensors
    return DiscrepancyModel().fit(**given).sample(3, seed=0)


def discrepancy_npe(**options: Any) -> DiscrepancyNPE:
    """Return a method whose model of the discrepancy is fitted in a few steps."""
    model = DiscrepancyModel(
        gain_precisions=(1.0,), error_scales=(0.1,), degrees_of_freedom=(3.0,)
    )
    return DiscrepancyNPE.from_posterior(
        npe(), simulations=(THETA_S, X_S), model=model, **options
    )


CALLS = [
    Call(
        name="DiscrepancyModel",
        run=lambda **options: repr(DiscrepancyModel(**options)),
        options={
            "gain_precisions": "numbers",
            "error_scales": "numbers",
            "degrees_of_freedom": "numbers",
            "probability_of_none": "share",
        },
    ),
    Call(
        name="DiscrepancyModel.fit",
        run=fitted,
        tensors={
            "z": X,
            "mean": THETA,
            "covariance": NOISE,
            "weights": torch.ones(len(X)),
        },
        pair_weights=("weights",),
        accepts=("weights: None",),
    ),
    Call(
        name="Discrepancy.sample",
        run=lambda num_draws=3, **options: fitted_discrepancy().sample(
            num_draws, **{"seed": 0, **options}
        ),
        options={
            "num_draws": "count",
            "smallest_error": "not negative",
            "seed": "seed",
        },
    ),
    Call(
        name="DiscrepancyDraws.correct",
        run=lambda z_s: fitted_discrepancy().sample(3, seed=0).correct(z_s),
        tensors={"z_s": X_S},
        accepts=("z_s: one row less",),
        is_random=True,
    ),
    Call(
        name="learn_parameters",
        run=lambda theta_cal=THETA, theta=THETA_S, weights=None: (
            learn_parameters(theta_cal, theta, weights=weights).probabilities
        ),
        tensors={
            "theta_cal": THETA,
            "theta": THETA_S,
            "weights": torch.ones(len(THETA)),
        },
        pair_weights=("weights",),
        accepts=("theta: one row less", "weights: None"),
    ),
    Call(
        name="DiscrepancyNPE",
        run=lambda **options: type(DiscrepancyNPE(PRIOR, **options)),
        options={
            "density_estimator": "choice",
            "simulator": "choice",
            "space": "choice",
            "learn_prior": "instance",
            "model": "instance",
            "num_simulations": "count",
            "simulations_per_pair": "count",
            "num_steps": "count",
            "learning_rate": "rate",
            "num_folds": "count",
            "finetuner": "instance",
            "npe_training": "instance",
            "device": "device",
        },
    ),
    Call(
        name="DiscrepancyNPE.train",
        run=lambda theta=THETA, x=X, seed=0: (
            discrepancy_npe(num_steps=2)
            .append_calibration(theta, x)
            .train(seed=seed, **QUIET)
            .history.training_loss
        ),
        tensors=PAIRS,
        options={"seed": "seed"},
    ),
    Call(
        name="DiscrepancyNPE.report",
        run=lambda x_names=None, seed=0: (
            discrepancy_npe()
            .append_calibration(THETA, X)
            .report(x_names=x_names, seed=seed, **QUIET)
            .summaries[0]
            .size.median
        ),
        options={"x_names": "names", "seed": "seed"},
    ),
    Call(
        name="DiscrepancyNPE.report(summaries)",
        run=lambda summaries=lambda x: x[:, :1]: (
            discrepancy_npe()
            .append_calibration(THETA, X)
            .report(summaries=summaries, **QUIET)
        ),
        options={"summaries": "function"},
    ),
]
