"""Stacks, their candidates and the diagnosis of a batch."""

from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from sbi_rope import StackedPosterior, diagnose, stack
from sbi_rope.stacking import (
    DensityCandidate,
    DiscrepancyCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
    RVNPCandidate,
    cross_validate,
    default_candidates,
    stacking_weights,
)
from tests.faults.outcomes import Call
from tests.faults.problem import (
    CANDIDATES,
    FEWER_X_O,
    LOG_SCORES,
    PAIRS,
    QUIET,
    THETA,
    X_O,
    X,
    stacked,
    trained,
)


def stacked_anew(x_o: Any = None, **options: Any) -> StackedPosterior:
    """Return a stack of two folds, with few draws to score it by."""
    given = {"num_folds": 2, "seed": 0} | QUIET | options
    with patch("sbi_rope.stacking.scoring.NUM_SAMPLES", 20):
        return stack(trained(), x_o, **given)


def distances_of(x_o: Any = X_O, **options: Any) -> Tensor:
    """Diagnose a batch, with few draws of the MMD of simulations."""
    given = {"num_simulations": 100, "num_folds": None, "seed": 0} | QUIET | options
    with patch("sbi_rope.diagnosis.misspecification.NUM_DRAWS", 10):
        return diagnose(trained(), x_o, **given).distance


CALLS = [
    Call(
        name="StackedPosterior.candidate_log_probs",
        run=lambda theta=THETA, x=X: stacked().candidate_log_probs(theta, x),
        tensors=PAIRS,
        accepts=("x: a list", "x: a NumPy array"),
    ),
    Call(
        name="stack",
        run=lambda candidates=CANDIDATES, **options: (
            stacked_anew(candidates=candidates, **options).candidate_weights
        ),
        options={
            "candidates": "instance",
            "num_folds": "count",
            "seed": "seed",
        },
    ),
    Call(
        name="stack(x_o)",
        run=lambda x_o=X_O: (
            stacked_anew(
                x_o, candidates=CANDIDATES
            ).report.cross_validation.stack_scores
        ),
        tensors={"x_o": X_O},
        accepts=("x_o: None", *FEWER_X_O),
    ),
    Call(
        name="cross_validate",
        run=lambda **options: (
            cross_validate(
                trained(),
                **{
                    "candidates": CANDIDATES,
                    "num_folds": 3,
                    "seed": 0,
                    **QUIET,
                    **options,
                },
            ).log_scores
        ),
        options={
            "num_training_folds": "count",
            "seed": "seed",
        },
    ),
    Call(
        name="default_candidates",
        run=lambda **options: repr(default_candidates(**options)),
        options={
            "rope": "instance",
            "learn_prior": "instance",
        },
    ),
    Call(
        name="default_candidates(x_o)",
        run=lambda x_o=X_O: repr(default_candidates(trained(), x_o)),
        tensors={"x_o": X_O},
        accepts=("x_o: None", *FEWER_X_O),
    ),
    Call(
        name="RVNPCandidate",
        run=lambda **options: repr(RVNPCandidate(X_O, **options)),
        options={"space": "choice"},
    ),
    Call(
        name="stacking_weights",
        run=lambda log_scores=LOG_SCORES, **options: (
            stacking_weights(log_scores, **options).weights
        ),
        tensors={"log_scores": LOG_SCORES},
        options={
            "pseudo_count": "not negative",
            "tolerance": "positive",
            "max_iterations": "count",
        },
        accepts=(
            "log_scores: one row less",
            "log_scores: one column more",
            "log_scores: no rows",
        ),
    ),
    Call(
        name="stacking_weights(weights of pairs)",
        run=lambda pair_weights: (
            stacking_weights(LOG_SCORES, pair_weights=pair_weights).weights
        ),
        tensors={"pair_weights": torch.ones(len(LOG_SCORES))},
        pair_weights=("pair_weights",),
        accepts=("pair_weights: None",),
    ),
    Call(
        name="diagnose",
        run=distances_of,
        tensors={"x_o": X_O},
        options={
            "num_simulations": "count",
            "coupler": "instance",
            "num_folds": "count",
            "posterior": "instance",
            "parameter_names": "names",
            "seed": "seed",
        },
        accepts=FEWER_X_O,
    ),
    Call(
        name="FinetunedCandidate",
        run=lambda **options: repr(FinetunedCandidate(**options)),
        options={"space": "choice"},
    ),
    Call(name="RehearsedCandidate", run=lambda: repr(RehearsedCandidate())),
    Call(
        name="DiscrepancyCandidate",
        run=lambda space="embedding", **options: repr(
            DiscrepancyCandidate(space=space, **options)
        ),
        options={"space": "choice"},
    ),
    Call(
        name="DensityCandidate",
        run=lambda name="mine", build=None, **options: repr(
            DensityCandidate(
                name=name,
                build=(lambda rope, seed: rope.npe) if build is None else build,
                **options,
            )
        ),
        options={
            "name": "text",
            "build": "function",
            "fixed": "instance",
            "learns_prior": "instance",
        },
    ),
]
