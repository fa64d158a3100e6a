"""RoPE, fine-tuning and coupling."""

import torch

from sbi_rope import CalibrationFinetuner, SinkhornCoupler, parallel
from tests import gaussian
from tests.faults.outcomes import Call
from tests.faults.problem import (
    COUPLED,
    FEWER_X_O,
    PAIRS,
    QUIET,
    SIMULATIONS,
    THETA,
    THETA_S,
    X_O,
    X_S,
    X,
    npe,
    posterior,
    trained,
    untrained,
)

CALLS = [
    Call(
        name="RoPE(simulations)",
        run=lambda theta=THETA_S, x=X_S: (
            untrained(simulations=(theta, x))
            .embed(X_O, num_simulations=30, seed=0)
            .simulated
        ),
        tensors=SIMULATIONS,
        accepts=("theta: NaN", "theta: Inf", "x: NaN", "x: Inf"),
    ),
    Call(
        name="RoPE",
        run=lambda **options: repr(untrained(**options)),
        options={
            "finetuner": "instance",
            "coupler": "instance",
            "num_simulations": "count",
            "parameter_names": "names",
        },
    ),
    Call(
        name="parallel",
        run=lambda simulator=gaussian.simulator, **options: type(
            parallel(simulator, **options)
        ),
        options={"simulator": "choice", "num_workers": "count"},
    ),
    Call(
        name="RoPE.append_calibration",
        run=lambda theta=THETA, x=X: (
            untrained().append_calibration(theta, x).calibration
        ),
        tensors=PAIRS,
        accepts=("theta: NaN",),  # a parameter that was not measured
    ),
    Call(
        name="RoPE.append_calibration(noise)",
        run=lambda **noise: (
            untrained().append_calibration(THETA, X, **noise).labels.covariance
        ),
        tensors={
            "theta_std": torch.full_like(THETA, 0.1),
            "weights": torch.ones(len(THETA)),
        },
        accepts=(
            "theta_std: None",
            "theta_std: a number",
            "theta_std: no dimension",
            "weights: None",
        ),
        pair_weights=("weights",),
    ),
    Call(
        name="RoPE.append_calibration(covariance)",
        run=lambda theta_cov: (
            untrained()
            .append_calibration(THETA, X, theta_cov=theta_cov)
            .labels.covariance
        ),
        tensors={"theta_cov": 0.1 * torch.eye(THETA.shape[1])},
        accepts=("theta_cov: None",),
    ),
    Call(
        name="RoPE.draw_targets",
        run=lambda **options: trained().draw_targets(
            **{"simulations_per_target": 3, **QUIET} | options
        ),
        options={"simulations_per_target": "count"},
        is_random=True,
    ),
    Call(
        name="RoPE.train",
        run=lambda **options: (
            untrained()
            .append_calibration(THETA, X)
            .train(**{"seed": 0, **QUIET, **options})
            .history.training_loss
        ),
        options={"seed": "seed"},
    ),
    Call(
        name="RoPE.with_pairs",
        run=lambda rows, **options: trained().with_pairs(rows, **options).calibration,
        tensors={"rows": torch.tensor([3, 0, 7])},
        options={"finetuner": "instance"},
        accepts=("rows: no rows",),
    ),
    Call(
        name="RoPE.with_pairs(targets)",
        run=lambda targets: (
            trained()
            .with_pairs(torch.tensor([3, 0, 7, 8]), targets=targets)
            .train(seed=0, **QUIET)
            .history.training_loss
        ),
        tensors={"targets": X[:4]},
        accepts=("targets: None",),
    ),
    Call(
        name="RoPE.checked_observations",
        run=lambda x_o: untrained().checked_observations(x_o),
        tensors={"x_o": X_O},
        accepts=FEWER_X_O,
    ),
    Call(
        name="RoPE.embed",
        run=lambda x_o=X_O, **options: (
            trained().embed(x_o, **{"seed": 0, "num_simulations": 30, **options}).real
        ),
        tensors={"x_o": X_O},
        options={"num_simulations": "count", "seed": "seed"},
        accepts=FEWER_X_O,
    ),
    Call(
        name="RoPE.build_posterior",
        run=lambda x_o=X_O, **options: (
            trained()
            .build_posterior(
                x_o, **{"seed": 0, "num_simulations": 30, **QUIET, **options}
            )
            .weights
        ),
        tensors={"x_o": X_O},
        options={
            "coupler": "instance",
            "num_simulations": "count",
            "seed": "seed",
            "unseen": "choice",
            "tail_mass": "share",
        },
        accepts=FEWER_X_O,
    ),
    Call(
        name="CalibrationFinetuner",
        run=lambda **options: repr(CalibrationFinetuner(**options)),
        options={
            "learning_rate": "rate",
            "max_num_epochs": "count",
            "stop_after_epochs": "count",
            "simulations_per_target": "count",
            "resample_targets": "instance",
            "num_neighbors": "count",
            "validation_fraction": "positive",
            "rehearsal": "not negative",
        },
    ),
    Call(
        name="CalibrationFinetuner.finetune",
        run=lambda x=X, targets=0.8 * THETA, groups=None, simulations=X_S, seed=0: (
            CalibrationFinetuner(max_num_epochs=2, rehearsal=1.0)
            .finetune(
                npe().posterior_estimator.embedding_net,
                x,
                lambda count: targets,
                draw_simulations=lambda count: simulations,
                groups=groups,
                seed=seed,
                **QUIET,
            )
            .history.training_loss
        ),
        tensors={"x": X, "targets": 0.8 * THETA, "simulations": X_S},
        options={"seed": "seed"},
        accepts=("simulations: one row less",),
    ),
    Call(
        name="CalibrationFinetuner.finetune(groups)",
        run=lambda groups: (
            CalibrationFinetuner(max_num_epochs=2)
            .finetune(
                npe().posterior_estimator.embedding_net,
                X,
                lambda count: 0.8 * THETA,
                groups=groups,
                seed=0,
                **QUIET,
            )
            .history.training_loss
        ),
        tensors={"groups": torch.arange(20) // 2},
        accepts=("groups: None",),
    ),
    Call(
        name="SinkhornCoupler",
        run=lambda **options: repr(SinkhornCoupler(**options)),
        options={
            "gamma": "positive",
            "tau": "share",
            "cost_scale": "choice",
            "solver": "choice",
            "tolerance": "positive",
            "max_iterations": "count",
            "dtype": "choice",
            "blocked": "choice",
            "num_fitted": "count",
        },
    ),
    Call(
        name="SinkhornCoupler.couple",
        run=lambda real=X_O, simulated=X_S, seed=0: (
            SinkhornCoupler().couple(real, simulated, seed=seed).weights
        ),
        tensors=COUPLED,
        accepts=("real: one row less", "simulated: one row less"),
    ),
    Call(
        name="SinkhornCoupler.couple(num_fitted)",
        run=lambda seed=0: (
            SinkhornCoupler(num_fitted=20).couple(X_O, X_S, seed=seed).weights
        ),
        options={"seed": "seed"},
    ),
    Call(
        name="Coupling.distances",
        run=lambda real: posterior().coupling.distances(real),
        tensors={"real": X_O},
        accepts=("real: one row less",),
    ),
    Call(
        name="Coupling.rows",
        run=lambda real: posterior().coupling.rows(real),
        tensors={"real": X_O},
        accepts=("real: one row less",),
    ),
    Call(
        name="Coupling.restricted_to",
        run=lambda rows: posterior().coupling.restricted_to(rows).weights,
        tensors={"rows": torch.tensor([3, 0, 7])},
        accepts=("rows: no rows",),
    ),
    Call(
        name="Coupling.to",
        run=lambda device="cpu": posterior().coupling.to(device).weights,
        options={"device": "device"},
    ),
]
