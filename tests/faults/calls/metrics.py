"""Scores of posteriors."""

from collections.abc import Callable
from typing import Any

import torch

from sbi_rope import metrics
from tests.faults.outcomes import Call
from tests.faults.problem import (
    PAIRS,
    THETA,
    X_O,
    X,
    draw,
    npe,
    posterior,
    stacked,
)

LEVELS = torch.linspace(0.0132, 0.9871, 40).reshape(20, 2)
SAMPLES = draw(6, 50, 20, 2)


def scored(score: Callable[..., Any], **settings: Any) -> Callable[..., Any]:
    return lambda theta=THETA, x=X, **options: score(
        stacked(), theta, x, **{**settings, **options}
    )


CALLS = [
    Call(
        name="evaluate",
        run=scored(metrics.evaluate, num_samples=20, seed=0),
        tensors=PAIRS,
        options={"num_samples": "count", "seed": "seed", "chunk_size": "count"},
    ),
    Call(
        name="evaluate(theta_std)",
        run=scored(metrics.evaluate, num_samples=20, seed=0),
        tensors={"theta_std": torch.tensor([1.0, 2.0])},
        accepts=("theta_std: None",),
    ),
    Call(
        name="lpp",
        run=scored(metrics.lpp),
        tensors=PAIRS,
        options={"chunk_size": "count"},
    ),
    Call(
        name="lpp(theta_std)",
        run=scored(metrics.lpp),
        tensors={"theta_std": torch.tensor([1.0, 2.0])},
        accepts=("theta_std: None",),
    ),
    Call(
        name="LPPScore.standardised",
        run=lambda theta_std: metrics.lpp(stacked(), THETA, X).standardised(theta_std),
        tensors={"theta_std": torch.tensor([1.0, 2.0])},
    ),
    Call(
        name="acauc",
        run=scored(metrics.acauc, num_samples=20, seed=0),
        tensors=PAIRS,
        options={
            "kind": "choice",
            "num_samples": "count",
            "num_observations": "count",
            "seed": "seed",
            "chunk_size": "count",
        },
    ),
    *(
        Call(
            name=score.__name__,
            run=scored(score, num_samples=20, seed=0),
            tensors=PAIRS,
            options={"num_samples": "count", "seed": "seed", "chunk_size": "count"},
        )
        for score in (metrics.coverage_curve, metrics.expected_coverage_error)
    ),
    *(
        Call(
            name=score.__name__,
            run=score,
            tensors={"levels": LEVELS},
            accepts=(
                "levels: one row less",
                "levels: one column more",
                # A single row has no standard error.
                "levels: one row",
                # In 16 bits the levels are other numbers.
                "levels: half",
                "levels: bfloat16",
            ),
        )
        for score in (
            metrics.acauc_of,
            metrics.coverage_curve_of,
            metrics.expected_coverage_error_of,
        )
    ),
    Call(
        name="central_levels",
        run=metrics.central_levels,
        tensors={"ranks": LEVELS},
        # Each entry has a level of its own, in any shape.
        accepts=tuple(
            f"ranks: {what}"
            for what in (
                "one row less",
                "one column more",
                "no dimension",
                "one dimension more",
                "one dimension less",
                "no rows",
                "bfloat16",
            )
        ),
    ),
    Call(
        name="coverage_by_estimate",
        run=lambda ranks=LEVELS, estimates=THETA, **options: (
            metrics.coverage_by_estimate(ranks, estimates, **options)
        ),
        tensors={"ranks": LEVELS, "estimates": THETA},
        options={"level": "share"},
    ),
    Call(
        name="mid_ranks",
        run=lambda samples=SAMPLES, theta=THETA: metrics.mid_ranks(samples, theta),
        tensors={"samples": SAMPLES, "theta": THETA},
        # Infinite numbers can be ranked.
        accepts=("samples: one row less", "samples: Inf", "theta: Inf"),
    ),
    Call(
        name="draw_samples",
        run=lambda x=X_O, num_samples=5: metrics.draw_samples(
            posterior(), x, num_samples=num_samples
        ),
        tensors={"x": X_O},
        options={"num_samples": "count"},
        accepts=("x: one row less",),
        is_random=True,
    ),
    Call(
        name="draw_samples(NPE)",
        run=lambda x=X_O, num_samples=5: metrics.draw_samples(
            npe(), x, num_samples=num_samples
        ),
        tensors={"x": X_O},
        accepts=("x: one row less",),
        is_random=True,
    ),
]
