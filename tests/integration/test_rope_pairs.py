"""What RoPE keeps to itself, and rehearsal."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from tests import problems
from tests.stacks import (
    NUM_OBSERVED,
    QUICK,
    QUIET,
    observed,
    rope_of,
    trained,
    unnormalised,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def test_npe_and_calibration_are_copies() -> None:
    rope = trained()
    original = problems.npe_posterior("mdn", "linear")
    theta, x_o = problems.box(2).sample((NUM_OBSERVED,)), observed()
    expected = unnormalised(original, theta, x_o)
    assert torch.allclose(unnormalised(rope.npe, theta, x_o), expected)
    npe: Any = rope.npe
    with torch.no_grad():
        for parameter in npe.posterior_estimator.parameters():
            parameter.zero_()
    assert torch.allclose(unnormalised(rope.npe, theta, x_o), expected)
    assert torch.allclose(unnormalised(original, theta, x_o), expected)
    pairs = rope.calibration
    for value in pairs:
        value.zero_()
    assert not any(map(torch.equal, pairs, rope.calibration))


# --- rehearsal ---


def test_rehearsal_keeps_the_embeddings_of_simulations_in_place() -> None:
    x = problems.simulate(problems.box(2).sample((500,)))
    moved = []
    for rehearsal in (0.0, 5.0):
        rope = rope_of(finetuner=replace(QUICK, rehearsal=rehearsal))
        rope.train(seed=0, **QUIET)
        distance = rope.tuned_embedding_net(x) - rope.embedding_net(x)
        moved.append(float(distance.norm(dim=1).mean()))
    assert moved[1] < 0.5 * moved[0]


def test_stored_simulations_can_be_rehearsed() -> None:
    theta = problems.box(2).sample((50,))  # fewer than a simulator would be asked for
    simulations = (theta, problems.simulate(theta))
    rope = rope_of(simulations=simulations).train(seed=0, **QUIET)
    other = rope_of(simulations=simulations, finetuner=replace(QUICK, rehearsal=1.0))
    other.train(seed=0, **QUIET)
    x = observed()
    assert not torch.equal(rope.tuned_embedding_net(x), other.tuned_embedding_net(x))
