"""Mixtures and stacks as posteriors."""

import copy

from sbi_rope.mixture import average
from tests.faults.outcomes import Call
from tests.faults.problem import (
    QUIET,
    THETA,
    THETA_O,
    X_O,
    posterior,
    stacked,
)

CALLS = [
    Call(
        name="average",
        run=lambda posteriors=None, **options: average(
            [stacked(), stacked()] if posteriors is None else posteriors, **options
        ).sample_batched((5,), x=X_O, **QUIET),
        options={"posteriors": "instance", "weights": "instance"},
        is_random=True,
    ),
]
CALLS += [
    Call(
        name="CredibleIntervals.as_rows",
        run=lambda **options: (
            stacked().credible_intervals(0.9, X_O[0], seed=0).as_rows(**options)
        ),
        options={"parameter_names": "names"},
        accepts=("parameter_names: ['a', 'a']",),
    ),
]
CALLS += [
    Call(
        name="CredibleIntervals.contains",
        run=lambda theta=THETA: (
            stacked().credible_intervals(0.9, X_O[0], seed=0).contains(theta).double()
        ),
        tensors={"theta": THETA},
        accepts=("theta: one row less", "theta: no rows"),
    ),
]
CALLS += [
    Call(
        name=name,
        run=lambda theta=THETA, guaranteed=guaranteed: (
            stacked()
            .credible_set(0.9, X_O[0], guaranteed=guaranteed, num_samples=20, seed=0)
            .contains(theta)
            .double()
        ),
        tensors={"theta": THETA},
        accepts=("theta: one row less", "theta: no rows"),
    )
    for name, guaranteed in (
        ("CredibleSet.contains", False),
        ("CredibleSet.contains(guaranteed)", True),
    )
]
CALLS += [
    call
    for kind, make, x in (
        ("MixturePosterior", posterior, X_O),
        ("StackedPosterior", stacked, X_O),
    )
    for call in (
        Call(
            name=f"{kind}.sample",
            run=lambda x=x[:1], sample_shape=(5,), make=make, **options: make().sample(
                sample_shape, x=x, **QUIET, **options
            ),
            tensors={"x": x[:1]},
            options={"max_sampling_batch_size": "count"},
            # A single observation may have no dimension for the batch.
            accepts=("x: a list", "x: a NumPy array", "x: one dimension less"),
            is_random=True,
        ),
        Call(
            name=f"{kind}.sample_batched",
            run=lambda x=x, sample_shape=(5,), make=make, **options: (
                make().sample_batched(sample_shape, x=x, **QUIET, **options)
            ),
            tensors={"x": x},
            options={"max_sampling_batch_size": "count"},
            accepts=("x: a list", "x: a NumPy array", "x: one row less"),
            is_random=True,
        ),
        *(
            Call(
                name=f"{kind}.{method}",
                run=lambda x=x[:1], make=make, method=method, **options: getattr(
                    make(), method
                )(x=x, **{"num_samples": 20, "seed": 0, **options}),
                tensors={"x": x[:1]},
                options={
                    "level": "share",
                    "guaranteed": "instance",
                    "num_samples": "count",
                    "seed": "seed",
                },
                accepts=("x: a list", "x: a NumPy array", "x: one dimension less"),
            )
            for method in ("credible_set", "credible_intervals")
        ),
        Call(
            name=f"{kind}.credible_intervals_batched",
            run=lambda x=x, make=make, **options: make().credible_intervals_batched(
                **{"level": 0.9, "num_samples": 20, "seed": 0, **options}, x=x
            ),
            tensors={"x": x},
            options={
                "level": "share",
                "guaranteed": "instance",
                "num_samples": "count",
                "seed": "seed",
            },
            accepts=("x: a list", "x: a NumPy array", "x: one row less"),
        ),
        Call(
            name=f"{kind}.log_prob",
            run=lambda theta=THETA, x=x[:1], make=make: make().log_prob(theta, x=x),
            tensors={"theta": THETA, "x": x[:1]},
            accepts=(
                "theta: a list",
                "theta: Inf",
                "theta: a NumPy array",
                "theta: one row less",
                "x: a list",
                "x: a NumPy array",
                "x: one dimension less",
            ),
        ),
        Call(
            name=f"{kind}.log_prob_batched",
            run=lambda theta=THETA_O, x=x, make=make: make().log_prob_batched(
                theta, x=x
            ),
            tensors={"theta": THETA_O, "x": x},
            accepts=(
                "theta: a list",
                "theta: Inf",
                "theta: a NumPy array",
                "x: a list",
                "x: a NumPy array",
                "x: one dimension less",
            ),
        ),
        Call(
            name=f"{kind}.potential",
            run=lambda theta=THETA, x=x[:1], make=make: make().potential(theta, x=x),
            tensors={"theta": THETA, "x": x[:1]},
            accepts=(
                "theta: a list",
                "theta: Inf",
                "theta: a NumPy array",
                "theta: one row less",
                "x: a list",
                "x: a NumPy array",
                "x: one dimension less",
            ),
        ),
        Call(
            name=f"{kind}.leakage",
            run=lambda x=x, make=make: make().leakage(x).mass,
            tensors={"x": x},
            accepts=("x: a list", "x: a NumPy array", "x: one row less"),
        ),
        Call(
            name=f"{kind}.set_default_x",
            run=lambda x=x[:1], make=make: (
                copy.copy(make()).set_default_x(x).potential(THETA)
            ),
            tensors={"x": x[:1]},
            accepts=("x: a list", "x: a NumPy array", "x: one dimension less"),
        ),
        Call(
            name=f"{kind}.map",
            run=lambda make=make, x=x, **options: (
                copy.copy(make())
                .set_default_x(x[0])
                .map(
                    **{
                        "num_iter": 2,
                        "num_to_optimize": 2,
                        "num_init_samples": 5,
                        **QUIET,
                        **options,
                    }
                )
            ),
            options={
                "num_iter": "count",
                "num_to_optimize": "count",
                "num_init_samples": "count",
            },
            is_random=True,
        ),
        Call(
            name=f"{kind}.to",
            run=lambda device="cpu", make=make: make().to(device),
            options={"device": "device"},
        ),
    )
]
