"""RoPE with some of its pairs and given targets, as the folds of a stack use it."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope._random import seeded
from sbi_rope._sbi import embed
from sbi_rope.errors import NotReadyError
from tests import gaussian, problems
from tests.stacks import (
    NUM_OBSERVED,
    NUM_PAIRS,
    QUICK,
    QUIET,
    observed,
    parameters,
    problem,
    rope_of,
    same,
    trained,
    uneven,
    unnormalised,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def targets_of(rope: RoPE, rows: Tensor, *, seed: int | None = 0) -> Tensor:
    h, finetuner = rope.embedding_net, rope.finetuner
    with seeded(seed):
        return rope.source.targets(
            rope.calibration[0][rows],
            lambda x: embed(h, x),
            simulations_per_target=finetuner.simulations_per_target,
            num_neighbors=finetuner.num_neighbors,
            progress=False,
        )


def test_targets_are_mean_embeddings_at_the_parameters_of_their_rows() -> None:
    rope = RoPE(
        gaussian.posterior(),
        simulator=gaussian.simulator,
        finetuner=CalibrationFinetuner(simulations_per_target=4000),
    )
    theta, x = gaussian.labelled(6)
    rope.append_calibration(theta, x)
    rows = torch.tensor([4, 0, 2])
    # h(S(theta)) = 0.8 (theta + 0.5 eps).
    error = gaussian.GAIN * gaussian.NOISE_STD / 4000**0.5
    expected = gaussian.GAIN * theta[rows]
    assert torch.allclose(targets_of(rope, rows), expected, atol=5 * error)


def test_targets_of_stored_simulations_are_the_embeddings_of_the_nearest() -> None:
    theta = problems.box(2).sample((100,))
    x = problems.simulate(theta)
    rope = rope_of((theta[:5] + 1e-4, x[:5] + 0.4), simulations=(theta, x))
    rows = torch.tensor([3, 0])
    with torch.no_grad():
        expected = rope.embedding_net(x[rows])
    assert torch.allclose(targets_of(rope, rows), expected, atol=1e-6)


def test_a_rope_with_some_pairs_tunes_on_these_towards_the_given_targets() -> None:
    rope = trained()
    theta, x = rope.calibration
    rows = torch.tensor([7, 2, 11, 5, 3, 1])
    targets = torch.randn(6, 4)
    part = rope.with_pairs(rows, targets=targets)
    assert all(map(torch.equal, part.calibration, (theta[rows], x[rows])))
    with pytest.raises(NotReadyError):
        _ = part.tuned_embedding_net
    part.train(seed=4, **QUIET)
    expected = rope.finetuner.finetune(
        rope.embedding_net, x[rows], lambda count: targets, seed=4, **QUIET
    )
    found = part.tuned_embedding_net
    assert same(parameters(found), parameters(expected.embedding_net))


def test_given_targets_are_not_used_if_pairs_are_added_or_targets_resampled() -> None:
    rope = trained()
    theta, x = rope.calibration
    rows = torch.arange(6)
    far = torch.full((6, 4), 100.0)
    grown = rope.with_pairs(rows, targets=far).append_calibration(theta[6:9], x[6:9])
    expected = rope.with_pairs(torch.arange(9)).train(seed=0, **QUIET)
    found = grown.train(seed=0, **QUIET)
    nets = (found.tuned_embedding_net, expected.tuned_embedding_net)
    assert same(parameters(nets[0]), parameters(nets[1]))

    finetuner = CalibrationFinetuner(
        max_num_epochs=3, simulations_per_target=2, resample_targets=True
    )
    rope = rope_of(finetuner=finetuner)
    nets = [
        rope.with_pairs(rows, targets=targets)
        .train(seed=0, **QUIET)
        .tuned_embedding_net
        for targets in (far, None)
    ]
    assert same(parameters(nets[0]), parameters(nets[1]))


def test_a_rope_with_some_pairs_does_not_change_the_other() -> None:
    rope = trained()
    net, (theta, x) = rope.tuned_embedding_net, rope.calibration
    part = rope.with_pairs(torch.arange(4)).train(seed=9, **QUIET)
    part.append_calibration(theta[:3], x[:3])
    assert all(map(torch.equal, rope.calibration, (theta, x)))
    assert same(parameters(rope.tuned_embedding_net), parameters(net))
    assert len(part.calibration[0]) == 7


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


# --- another finetuner, and rehearsal ---


def counted() -> tuple[list[int], RoPE]:
    calls: list[int] = []

    def simulator(theta: Tensor) -> Tensor:
        calls.append(len(theta))
        return uneven(theta)

    rope = RoPE(
        problems.npe_posterior("mdn", "linear"),
        simulator=simulator,
        finetuner=replace(QUICK, rehearsal=1.0),
    )
    return calls, rope.append_calibration(*problem(NUM_PAIRS, seed=1))


def test_rehearsal_keeps_the_embeddings_of_simulations_in_place() -> None:
    x = problems.simulate(problems.box(2).sample((500,)))
    moved = []
    for rehearsal in (0.0, 5.0):
        rope = rope_of(finetuner=replace(QUICK, rehearsal=rehearsal))
        rope.train(seed=0, **QUIET)
        distance = rope.tuned_embedding_net(x) - rope.embedding_net(x)
        moved.append(float(distance.norm(dim=1).mean()))
    assert moved[1] < 0.5 * moved[0]


def test_simulations_for_rehearsal_are_made_once_for_all_folds() -> None:
    calls, rope = counted()
    rope.train(seed=0, **QUIET)
    calls.clear()
    rows = torch.arange(10)
    targets = targets_of(rope, rows)
    simulated = sum(calls)
    part = rope.with_pairs(rows, targets=targets).train(seed=0, **QUIET)
    assert sum(calls) == simulated
    # Who drew the simulations first does not matter.
    _, other = counted()
    alone = other.with_pairs(rows, targets=targets).train(seed=0, **QUIET)
    nets = (part.tuned_embedding_net, alone.tuned_embedding_net)
    assert same(parameters(nets[0]), parameters(nets[1]))


def test_stored_simulations_can_be_rehearsed() -> None:
    theta = problems.box(2).sample((50,))  # fewer than a simulator would be asked for
    simulations = (theta, problems.simulate(theta))
    rope = rope_of(simulations=simulations).train(seed=0, **QUIET)
    other = rope_of(simulations=simulations, finetuner=replace(QUICK, rehearsal=1.0))
    other.train(seed=0, **QUIET)
    nets = (rope.tuned_embedding_net, other.tuned_embedding_net)
    assert not same(parameters(nets[0]), parameters(nets[1]))
